"use strict";
(() => {
  const read = (id) => JSON.parse(document.getElementById(id).textContent);
  const element = (id) => document.getElementById(id);
  const views = read("data"), layers = read("layer-data"), legend = read("legend-data");
  const tiles = element("tiles");
  const state = { index: 0, layer: "final", scale: 1, x: 0, y: 0, groundTruth: false };
  const MOST = 32, STEP = 1.25, PAN = 0.1;
  /* The layer in the ground-truth tile beside error maps. */
  const BESIDE = { error: "final", normal_error: "normal" };

  /* Zoom: one scale and one offset for all pictures. The offset is in widths and heights of a tile, so that tiles of
     every size agree. */
  function place() {
    state.scale = Math.min(MOST, Math.max(1, state.scale));
    const least = 1 - state.scale;
    state.x = Math.min(0, Math.max(least, state.x));
    state.y = Math.min(0, Math.max(least, state.y));
    for (const key of ["scale", "x", "y"]) tiles.style.setProperty("--" + key, state[key]);
    tiles.classList.toggle("zoomed", state.scale > 1);
    element("zoom-reset").textContent = Math.round(state.scale * 100) + " %";
  }

  function zoom(factor, x = 0.5, y = 0.5) {
    const scale = Math.min(MOST, Math.max(1, state.scale * factor));
    state.x = x - ((x - state.x) * scale) / state.scale;
    state.y = y - ((y - state.y) * scale) / state.scale;
    state.scale = scale;
    place();
  }

  function reset() {
    Object.assign(state, { scale: 1, x: 0, y: 0 });
    place();
  }

  function make(tag, className, text) {
    const node = document.createElement(tag);
    if (className) node.className = className;
    if (text) node.textContent = text;
    return node;
  }

  function draw() {
    const view = views[state.index];
    const groundTruth = view.tiles[0][1];
    const beside = BESIDE[state.layer] || state.layer;
    tiles.replaceChildren(...view.tiles.map(([name, pictures, scores], index) => {
      const tile = make("figure", index ? "tile" : "tile ground-truth");
      const caption = make("figcaption");
      const beneath = index || beside === state.layer ? scores[state.layer] : layers[beside];
      caption.append(make("b", "", name), make("span", "", beneath || ""));
      const frame = make("div", "window");
      frame.style.aspectRatio = view.width + " / " + view.height;
      const source = index === 0 || (state.groundTruth && groundTruth[beside]) ? groundTruth[beside] : pictures[state.layer];
      if (source) {
        const picture = make("img");
        picture.src = source;
        picture.alt = name + ", " + layers[state.layer];
        frame.append(picture);
      } else {
        frame.append(make("p", "", "n/a"));
      }
      tile.append(caption, frame);
      return tile;
    }));
    for (const button of element("layers").children) {
      button.setAttribute("aria-pressed", String(button.dataset.layer === state.layer));
    }
    element("scale").hidden = !(state.layer in legend);
    element("range").textContent = legend[state.layer] || "";
  }

  function choose(index) {
    state.index = index;
    const scene = views[index].scene;
    element("scene").value = scene;
    element("view").replaceChildren(...views.flatMap((view, i) => {
      if (view.scene !== scene) return [];
      const option = make("option", "", view.view);
      option.value = String(i);
      return [option];
    }));
    element("view").value = String(index);
    draw();
  }

  function chooseLayer(layer) {
    state.layer = layer;
    draw();
  }

  function setUpChoices() {
    const scenes = [...new Set(views.map((view) => view.scene))];
    element("scene").replaceChildren(...scenes.map((scene) => make("option", "", scene)));
    element("scene-choice").hidden = scenes.length < 2;
    element("scene").onchange = (event) =>
      choose(views.findIndex((view) => view.scene === event.target.value));
    element("view").onchange = (event) => choose(Number(event.target.value));
    element("layers").replaceChildren(...Object.entries(layers).map(([layer, label]) => {
      const button = make("button", "", label);
      button.type = "button";
      button.dataset.layer = layer;
      button.onclick = () => chooseLayer(layer);
      return button;
    }));
    element("zoom-in").onclick = () => zoom(STEP);
    element("zoom-out").onclick = () => zoom(1 / STEP);
    element("zoom-reset").onclick = reset;
    element("size").oninput = (event) => tiles.style.setProperty("--size", event.target.value + "px");
  }

  function setUpPointer() {
    let drag = null;
    tiles.addEventListener("wheel", (event) => {
      const frame = event.target.closest(".window");
      if (!frame || (state.scale === 1 && event.deltaY > 0)) return; /* at full size: scroll the page */
      event.preventDefault();
      const box = frame.getBoundingClientRect();
      const factor = Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0018));
      zoom(factor, (event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
    }, { passive: false });
    tiles.addEventListener("pointerdown", (event) => {
      const frame = event.target.closest(".window");
      if (!frame || event.button) return;
      drag = { frame, x: event.clientX, y: event.clientY };
      frame.setPointerCapture(event.pointerId);
    });
    tiles.addEventListener("pointermove", (event) => {
      if (!drag) return;
      const box = drag.frame.getBoundingClientRect();
      state.x += (event.clientX - drag.x) / box.width;
      state.y += (event.clientY - drag.y) / box.height;
      drag.x = event.clientX;
      drag.y = event.clientY;
      place();
    });
    for (const end of ["pointerup", "pointercancel"]) tiles.addEventListener(end, () => { drag = null; });
    tiles.addEventListener("dblclick", reset);
  }

  function setUpKeys() {
    const keys = {
      "+": () => zoom(STEP), "=": () => zoom(STEP), "-": () => zoom(1 / STEP), "0": reset,
      "[": () => choose((state.index + views.length - 1) % views.length),
      "]": () => choose((state.index + 1) % views.length),
    };
    Object.keys(layers).forEach((layer, index) => { keys[String(index + 1)] = () => chooseLayer(layer); });
    const moves = { ArrowLeft: [PAN, 0], ArrowRight: [-PAN, 0], ArrowUp: [0, PAN], ArrowDown: [0, -PAN] };
    document.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || /SELECT|INPUT/.test(event.target.tagName)) return;
      if (event.key in moves && state.scale > 1) {
        const [x, y] = moves[event.key];
        state.x += x;
        state.y += y;
        place();
      } else if (event.key === "t" && !event.repeat) {
        state.groundTruth = true;
        draw();
      } else if (event.key in keys) {
        keys[event.key]();
      } else {
        return;
      }
      event.preventDefault();
    });
    const release = () => { if (state.groundTruth) { state.groundTruth = false; draw(); } };
    document.addEventListener("keyup", (event) => { if (event.key === "t") release(); });
    window.addEventListener("blur", release);
  }

  /* A choice of the columns of a section's tables, which have the same: a table is wider than many windows. */
  function setUpColumns() {
    for (const section of document.querySelectorAll("section")) {
      const tables = [...section.querySelectorAll(".scroll > table:not(.facts)")];
      if (!tables.length) continue;
      const labels = Number(tables[0].className.match(/labels(\d)/)[1]);
      const heads = [...tables[0].tHead.rows[0].cells].slice(labels);
      if (heads.length < 5) continue;
      const choice = make("details", "columns");
      choice.append(make("summary", "", `columns (${heads.length})`));
      heads.forEach((head, place) => {
        const label = make("label"), box = make("input");
        box.type = "checkbox";
        box.checked = true;
        box.onchange = () => {
          for (const table of tables)
            for (const row of table.rows) row.cells[labels + place].hidden = !box.checked;
        };
        label.append(box, head.textContent);
        choice.append(label);
      });
      section.querySelector("h2").after(choice);
    }
  }

  setUpColumns();
  if (views.length) {
    setUpChoices();
    setUpPointer();
    setUpKeys();
    choose(0);
    place();
  }
})();
