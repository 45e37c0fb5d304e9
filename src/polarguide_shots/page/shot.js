"use strict";
const data = $data;
const at = (id) => document.getElementById(id);
const buttons = [...document.querySelectorAll("[data-layer]")], legends = [...document.querySelectorAll(".legend")];
const size = data.width * data.height;
let planes = null, x = -1, y = -1;

function show(index) {
  at("map").src = data.layers[index];
  buttons.forEach((button, k) => button.setAttribute("aria-pressed", String(k === index)));
  legends.forEach((legend, k) => { legend.hidden = k !== index; });
}

// Zeniths at which diffuse light, and specular light below and above Brewster's angle, have this degree of polarization.
function candidates(d) {
  const n = data.index, n2 = n * n;
  const diffuse = d > (n2 - 1) / (n2 + 1) ? NaN : Math.atan2(n * Math.sqrt(2 * d), n * Math.sqrt(1 - d) - Math.sqrt(1 + d));
  const q = d / (1 + Math.sqrt(1 - d * d)), less = n2 - 1;
  const below = Math.atan(Math.sqrt(q * (Math.sqrt(less * less * q * q + 4 * n2) + less * q) / 2));
  const above = Math.atan2(Math.sqrt(2 * (Math.sqrt(less * less + 4 * n2 * q * q) + less)), 2 * q);
  return [diffuse, below, above];
}

async function unpack() {
  const packed = Uint8Array.from(atob(data.numbers), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  planes = new Uint8Array(await new Response(stream).arrayBuffer());
  data.numbers = "";
}

function say() {
  if (planes === null || x < 0) return;
  const pixel = y * data.width + x;
  const byte = (plane) => planes[plane * size + pixel];
  const share = (plane) => (byte(plane) * 256 + byte(plane + 1)) / 65535;
  const sigma = (plane) => data.least * Math.pow(data.most / data.least, byte(plane) / 255);
  const degrees = (radians) => radians * 180 / Math.PI;
  const dolp = share(2), s0 = share(0) * data.top, reason = byte(13);
  const rows = [["pixel", x * data.step + ", " + y * data.step], ["S0", s0.toFixed(4)]];
  if (reason < 2) {
    rows.push(["DoLP", dolp.toFixed(4) + " ± " + sigma(6).toPrecision(2)]);
    rows.push(["AoLP", degrees(share(4) * Math.PI).toFixed(1) + "° ± " + Math.min(degrees(sigma(7)), 52).toPrecision(2) + "°"]);
  }
  if (reason === 0) {
    const n = [8, 9, 10].map((plane) => ((byte(plane) - 128) / 127).toFixed(2));
    const zeniths = candidates(dolp).map((zenith) => degrees(zenith).toFixed(1) + "°");
    rows.push(["normal", n.join(", ")], ["zenith if diffuse", Number.isNaN(candidates(dolp)[0]) ? "none" : zeniths[0]]);
    rows.push(["if specular", zeniths[1] + " or " + zeniths[2]]);
    const part = (plane) => (byte(plane) / 255 * s0).toFixed(3);
    rows.push(["specular, exact", part(11)], ["specular, paper", part(12)]);
  }
  rows.push(["", data.reasons[reason]]);
  const parts = rows.map(([name, value]) => {
    const part = document.createElement("span"), label = document.createElement("b");
    label.textContent = name;
    part.append(label, value);
    return part;
  });
  at("values").replaceChildren(...parts);
  const cross = at("cross"), map = at("map");
  cross.hidden = false;
  cross.style.left = (x + 0.5) / data.width * map.clientWidth + "px";
  cross.style.top = (y + 0.5) / data.height * map.clientHeight + "px";
}

function point(event) {
  const box = at("map").getBoundingClientRect();
  const limit = (share, count) => Math.min(Math.max(Math.floor(share * count), 0), count - 1);
  x = limit((event.clientX - box.left) / box.width, data.width);
  y = limit((event.clientY - box.top) / box.height, data.height);
  say();
}

function move(event) {
  const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  if (!by) return;
  event.preventDefault();
  x = Math.min(Math.max(x + by[0], 0), data.width - 1);
  y = Math.min(Math.max(y + by[1], 0), data.height - 1);
  say();
}

buttons.forEach((button, k) => button.addEventListener("click", () => show(k)));
at("sheet").addEventListener("pointermove", point);
at("sheet").addEventListener("pointerdown", point);
at("sheet").addEventListener("keydown", move);
at("zoom").addEventListener("click", () => {
  const whole = at("stage").classList.toggle("whole");
  at("zoom").setAttribute("aria-pressed", String(whole));
  say();
});
addEventListener("resize", say);
show(0);
unpack().then(say, () => { at("values").textContent = "This browser cannot unpack the numbers; the pictures are whole."; });
