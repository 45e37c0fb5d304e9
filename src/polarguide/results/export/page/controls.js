/** Mouse, touch and keyboard controls of the picture. `moved` is called after every change of the camera. */
function listen(canvas, navigation, moved, press) {
  const fingers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  for (const end of ["pointerup", "pointercancel"])
    canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const height = canvas.clientHeight, now = [event.clientX, event.clientY];
    const dx = (now[0] - before[0]) / height, dy = (now[1] - before[1]) / height;
    if (fingers.size === 1) {
      if (event.shiftKey || event.buttons & 6) navigation.pan(dx, dy);
      else navigation.orbit(-4 * dx, -4 * dy);
    } else if (fingers.size === 2) {
      const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const apart = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]);
      navigation.zoom(apart(before) / Math.max(apart(now), 1));
      navigation.pan(dx / 2, dy / 2);
    }
    fingers.set(event.pointerId, now);
    moved();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    navigation.zoom(Math.exp(Math.max(-200, Math.min(200, event.deltaY)) * 0.0015));
    moved();
  }, { passive: false });
  // The whole page listens, so that keys work without a click first; controls keep the keys that move them.
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.defaultPrevented) return;
    if (event.target.matches?.("input:not([type=checkbox]), select, textarea") && event.key !== "Escape") return;
    const [x, y] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key] || [0, 0];
    if (x || y) event.shiftKey ? navigation.pan(-x / 20, -y / 20) : navigation.orbit(x / 12, y / 12);
    else if (event.key === "+" || event.key === "=") navigation.zoom(1 / 1.1);
    else if (event.key === "-") navigation.zoom(1.1);
    else if (!press(event.key)) return;
    event.preventDefault();
    moved();
  });
}
