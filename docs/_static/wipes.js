// Turn each sheet of pictures in the gallery into a slider between two of its pictures.
// A sheet has a column for each of COLUMNS and a row for each of LAYERS. The last column is always the right picture.
"use strict";
const COLUMNS = ["photograph or truth", "3dgs", "ours without polarization", "ours"];
const LAYERS = ["picture", "specular layer", "normals"];

function element(name, properties, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

function choice(label, names, choose) {
  const options = names.map((name) => element("option", { textContent: name }));
  const list = element("select", { ariaLabel: label }, ...options);
  list.addEventListener("change", () => choose(list.selectedIndex));
  return list;
}

function cell(sheet, column) {
  const picture = sheet.cloneNode();
  picture.className = "";
  const frame = element("div", {}, picture);
  frame.style.setProperty("--column", column);
  return frame;
}

function slider(sheet) {
  const left = cell(sheet, 0);
  const right = cell(sheet, COLUMNS.length - 1);
  const pictures = element("div", { className: "pictures" }, left, right);
  const columns = COLUMNS.slice(0, -1);
  const controls = element("p", {},
    choice("left picture", columns, (column) => left.style.setProperty("--column", column)),
    ` | ${COLUMNS.at(-1)} · `,
    choice("layer", LAYERS, (layer) => pictures.style.setProperty("--layer", layer)));
  const edge = element("input", { type: "range", value: 50, ariaLabel: "edge between the pictures" });
  edge.addEventListener("input", () => pictures.style.setProperty("--edge", `${edge.value}%`));
  sheet.replaceWith(element("div", { className: "wipe" }, controls, pictures, edge));
}

document.addEventListener("DOMContentLoaded", () => document.querySelectorAll("img.wipe").forEach(slider));
