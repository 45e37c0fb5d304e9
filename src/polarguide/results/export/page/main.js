// In the order of the indices in shade.frag.
const LAYERS = ["final", "diffuse", "specular", "base", "strength", "normal", "metalness", "roughness"];
const AS_PHOTOGRAPHED = [1, 0, 0, 0, 1, 0, 0, 0, 1];
const byId = (id) => document.getElementById(id);

class Page {
  constructor(scene, renderer, orders) {
    Object.assign(this, { scene, renderer, orders });
    this.canvas = renderer.canvas;
    this.navigation = new Navigation(scene);
    this.looks = { layer: 0, turn: 0, gain: 1, exposure: 2 ** scene.exposure, color: scene.color || AS_PHOTOGRAPHED };
    this.scale = new ScaleBar(byId("scale"), scene.metersPerUnit);
    this.compare = 0.5;
    this.comparing = false;
    this.coarse = 1; // screen pixels per rendered pixel while the camera moves
    this.moving = 0;
    this.sorted = "";
    this.waiting = null;
    this.bind();
    new ResizeObserver(() => this.redraw()).observe(this.canvas.parentElement);
    listen(this.canvas, this.navigation, () => this.move(), (key) => this.press(key));
    this.redraw();
  }

  bind() {
    const { scene } = this;
    scene.layers.forEach((name, place) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = scene.words[name].label;
      button.dataset.layer = name;
      button.title = `${scene.words[name].sentence} (${place + 1})`;
      button.onclick = () => this.choose(name);
      byId("layers").append(button);
    });
    scene.cameras.forEach((camera, place) => byId("view").append(new Option(camera.name, String(place))));
    byId("view").value = String(scene.first);
    byId("view").onchange = () => this.go(Number(byId("view").value));
    for (const name of ["turn", "gain", "exposure"])
      byId(name).oninput = () => {
        const value = Number(byId(name).value);
        this.looks[name] = name === "exposure" ? 2 ** value : value;
        this.redraw();
      };
    byId("exposure").value = String(scene.exposure);
    byId("balance").hidden = !scene.color;
    byId("white").onchange = () => this.setBalanced(byId("white").checked);
    byId("lit").hidden = scene.kind === "plain";
    byId("reset").onclick = () => this.reset();
    byId("compare").onclick = () => this.setComparing(!this.comparing);
    byId("compare").hidden = scene.kind === "plain";
    const handle = byId("handle"), stage = this.canvas.parentElement;
    handle.onpointerdown = (event) => handle.setPointerCapture(event.pointerId);
    handle.onpointermove = (event) => {
      if (!event.buttons) return;
      const box = stage.getBoundingClientRect();
      this.setSplit((event.clientX - box.left) / box.width);
    };
    handle.onkeydown = (event) => {
      const step = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
      if (!step) return;
      event.preventDefault();
      this.setSplit(this.compare + step);
    };
    this.choose(scene.layers[0]);
    this.setComparing(false);
  }

  choose(name) {
    this.looks.layer = LAYERS.indexOf(name);
    this.explain(name);
    for (const button of byId("layers").children)
      button.setAttribute("aria-pressed", String(button.dataset.layer === name));
    this.redraw();
  }

  /** The legend of a layer, and its name at the handle. */
  explain(name) {
    const { label, sentence, low, high } = this.scene.words[name], { gloss } = this.scene;
    const brighter = name === "specular" && gloss > 1 ? `, ${gloss} times as bright` : "";
    byId("sentence").textContent = `${label}: ${sentence}${brighter}`;
    byId("right").textContent = label;
    byId("low").textContent = low;
    byId("high").textContent = high;
    byId("ends").hidden = !high;
  }

  setBalanced(on) {
    byId("white").checked = on;
    this.looks.color = on && this.scene.color || AS_PHOTOGRAPHED;
    this.redraw();
  }

  setComparing(on) {
    this.comparing = on;
    byId("handle").hidden = !on;
    if (on) byId("drag").className = "done"; // the names at the handle stand there
    byId("compare").setAttribute("aria-pressed", String(on));
    this.setSplit(this.compare);
  }

  setSplit(share) {
    this.compare = Math.max(0, Math.min(1, share));
    byId("handle").style.left = `${100 * this.compare}%`;
    byId("handle").setAttribute("aria-valuenow", String(Math.round(100 * this.compare)));
    this.redraw();
  }

  go(place) {
    this.navigation.stand(this.scene.cameras[place]);
    this.redraw();
  }

  reset() {
    for (const [name, value] of [["turn", 0], ["gain", 1], ["exposure", this.scene.exposure]]) {
      byId(name).value = String(value);
      this.looks[name] = name === "exposure" ? 2 ** value : value;
    }
    byId("view").value = String(this.scene.first);
    this.setBalanced(true);
    this.setComparing(false);
    this.choose(this.scene.layers[0]);
    this.navigation.open();
    this.redraw();
  }

  press(key) {
    const { layers, cameras, kind } = this.scene, step = { n: 1, p: -1 }[key];
    if (layers[Number(key) - 1]) this.choose(layers[Number(key) - 1]);
    else if (key === "c" && kind !== "plain") this.setComparing(!this.comparing);
    else if (key === "w" && !byId("balance").hidden) this.setBalanced(!byId("white").checked);
    else if (key === "r") this.reset();
    else if (step) {
      byId("view").value = String((Number(byId("view").value) + step + cameras.length) % cameras.length);
      this.go(Number(byId("view").value));
    } else if ((key === "[" || key === "]") && kind !== "plain") {
      byId("turn").value = String(Number(byId("turn").value) + (key === "]" ? 5 : -5));
      byId("turn").oninput();
    } else return false;
    return true;
  }

  /** Render at low resolution while the camera moves. */
  move() {
    this.moving = performance.now();
    byId("drag").className = "done";
    this.redraw();
    clearTimeout(this.resting);
    this.resting = setTimeout(() => {
      this.moving = 0;
      this.redraw();
    }, 250);
  }

  redraw() {
    this.waiting ??= new Promise((resolve) => requestAnimationFrame(() => resolve(this.frame())));
    return this.waiting;
  }

  async frame() {
    this.waiting = null;
    const begin = performance.now(), box = this.canvas.parentElement;
    const sharp = Math.min(window.devicePixelRatio || 1, 2) / (this.moving ? this.coarse : 1);
    const size = [box.clientWidth, box.clientHeight].map((side) => Math.max(1, Math.round(side * sharp)));
    const camera = this.navigation.camera(...size);
    this.scale.show(camera, Math.hypot(...add(this.navigation.pivot, this.navigation.eye, -1)), box.clientWidth);
    if (!this.drawing) await this.draw(camera);
    else this.again = true;
    if (!this.moving) return;
    const spent = performance.now() - begin;
    if (spent > 60) this.coarse = Math.min(6, this.coarse * 1.3);
    else if (spent < 25) this.coarse = Math.max(1, this.coarse / 1.15);
  }

  /** Sort, blend and shade for a camera; the canvas gets its size. */
  async draw(camera) {
    this.drawing = true;
    const pose = String([camera.rotation.slice(6), camera.translation[2]]);
    if (pose !== this.sorted) {
      this.renderer.setOrder(await this.orders.of(camera));
      this.sorted = pose;
    }
    if (this.canvas.width !== camera.width) this.canvas.width = camera.width;
    if (this.canvas.height !== camera.height) this.canvas.height = camera.height;
    this.renderer.splat(camera);
    this.renderer.shade(camera, { ...this.looks, split: this.comparing ? this.compare * camera.width : 0 });
    if (this.moving) this.renderer.wait();
    this.drawing = false;
    if (this.again) {
      this.again = false;
      this.redraw();
    }
  }

  /** Layers at a photograph's pose and size, as data URLs of PNG pictures. */
  async pictures(view, layers) {
    const place = this.scene.cameras.findIndex((camera) => camera.name === view);
    if (place < 0 || !layers.every((name) => this.scene.layers.includes(name))) throw new Error("no such view or layer");
    while (this.drawing || this.waiting) await new Promise((resolve) => setTimeout(resolve, 5));
    const { looks, comparing } = this, addresses = [];
    this.comparing = false;
    for (const name of layers) {
      this.looks = { ...looks, layer: LAYERS.indexOf(name) };
      await this.draw(this.scene.cameras[place]);
      addresses.push(this.canvas.toDataURL("image/png"));
    }
    Object.assign(this, { looks, comparing });
    this.redraw();
    return addresses;
  }
}

async function main() {
  const scene = JSON.parse(byId("scene").textContent), shaders = JSON.parse(byId("shaders").textContent);
  const [planes, light, network, viridis] = await Promise.all(["records", "light", "network", "viridis"].map(unpacked));
  const words = records(planes, scene.count, 16 * scene.texels);
  const arrays = {
    records: words, viridis,
    light: light && new Uint16Array(light.buffer),
    network: network && new Float32Array(network.buffer),
  };
  const canvas = byId("picture"), renderer = new Renderer(canvas, scene, shaders, arrays);
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    say("The WebGL context was lost. Reload the page.");
  });
  window.polarguide = new Page(scene, renderer, new Orders(meansOf(words, scene.count, scene.texels)));
  await window.polarguide.redraw();
  byId("message").hidden = true;
}

function say(text) {
  byId("message").textContent = text;
  byId("message").hidden = false;
}

main().catch((error) => {
  say(error instanceof Unable ? error.message : `This page cannot be shown here: ${error.message}`);
  throw error;
});
