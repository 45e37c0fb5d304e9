// Decode the page's data to arrays, and sort the Gaussians in a worker.
async function unpacked(id) {
  const text = byId(id).textContent.trim();
  if (!text) return null;
  const letters = atob(text), bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; ++i) bytes[i] = letters.charCodeAt(i);
  const whole = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(whole).arrayBuffer());
}

/** Interleave the records, which are stored by byte position: byte k of all Gaussians first. */
function records(planes, count, size) {
  const bytes = new Uint8Array(count * size);
  for (let k = 0; k < size; ++k) {
    const plane = planes.subarray(k * count, (k + 1) * count);
    for (let i = 0, at = k; i < count; ++i, at += size) bytes[at] = plane[i];
  }
  return new Uint32Array(bytes.buffer);
}

function meansOf(words, count, texels) {
  const numbers = new Float32Array(words.buffer), means = new Float32Array(3 * count);
  for (let i = 0; i < count; ++i) for (let k = 0; k < 3; ++k) means[3 * i + k] = numbers[4 * texels * i + k];
  return means;
}

/** Requests sorted orders, one at a time. */
class Orders {
  constructor(means) {
    this.asked = new Map();
    this.next = 0;
    this.means = means;
    try {
      const text = `${depthOrder}\n${serveOrders}\nserveOrders();`;
      this.worker = new Worker(URL.createObjectURL(new Blob([text], { type: "text/javascript" })));
      this.worker.onmessage = ({ data }) => {
        this.asked.get(data.id)(data.order);
        this.asked.delete(data.id);
      };
      this.worker.postMessage({ means });
    } catch {
      this.worker = null; // workers are not allowed here: sort in the main thread
    }
  }

  of(camera) {
    const forward = camera.rotation.slice(6), offset = -camera.translation[2];
    if (!this.worker) return Promise.resolve(depthOrder(this.means, this.means.length / 3, forward, offset));
    return new Promise((resolve) => {
      this.asked.set(++this.next, resolve);
      this.worker.postMessage({ id: this.next, forward, offset });
    });
  }
}
