// Runs in a worker: sorts the Gaussians back to front.
function depthOrder(means, count, forward, offset) {
  const depth = new Float32Array(count), bits = new Uint32Array(depth.buffer);
  let order = new Uint32Array(count), other = new Uint32Array(count), shown = 0;
  for (let i = 0; i < count; ++i) {
    const z = means[3 * i] * forward[0] + means[3 * i + 1] * forward[1] + means[3 * i + 2] * forward[2] - offset;
    depth[i] = z;
    if (z > 0.01) order[shown++] = i;
  }
  // A stable radix sort in three passes on the inverted bits of positive floats.
  for (let shift = 0; shift < 32; shift += 11) {
    const begin = new Uint32Array(2049);
    for (let i = 0; i < shown; ++i) ++begin[((~bits[order[i]] >>> shift) & 2047) + 1];
    for (let k = 0; k < 2048; ++k) begin[k + 1] += begin[k];
    for (let i = 0; i < shown; ++i) other[begin[(~bits[order[i]] >>> shift) & 2047]++] = order[i];
    [order, other] = [other, order];
  }
  return order.slice(0, shown);
}

function serveOrders() {
  let means = null;
  self.onmessage = ({ data }) => {
    if (data.means) means = data.means;
    else {
      const order = depthOrder(means, means.length / 3, data.forward, data.offset);
      self.postMessage({ id: data.id, order }, [order.buffer]);
    }
  };
}
