/** A bar whose length is told, as on a map: at the distance of the pivot, a round length of at most a quarter of the width. */
class ScaleBar {
  constructor(element, metersPerUnit) {
    this.element = element;
    this.metersPerUnit = metersPerUnit;
    element.hidden = !metersPerUnit;
  }

  /** For a camera of the shown picture, `wide` CSS pixels wide, and the distance of what is looked at. */
  show(camera, distance, wide) {
    if (!this.metersPerUnit) return;
    const meters = this.metersPerUnit * distance * camera.width / (camera.fx * wide); // of a CSS pixel
    const most = 0.25 * wide * meters, power = 10 ** Math.floor(Math.log10(most));
    const length = power * [5, 2, 1].find((step) => step * power <= most * (1 + 1e-9));
    this.element.style.width = `${length / meters}px`;
    this.element.textContent = ScaleBar.text(length);
  }

  static text(meters) {
    const [unit, size] = [["km", 1e3], ["m", 1], ["cm", 0.01], ["mm", 0.001], ["\u00b5m", 1e-6]]
      .find(([, size]) => meters >= size * (1 - 1e-9)) || ["\u00b5m", 1e-6];
    return `${Number((meters / size).toPrecision(3))} ${unit}`;
  }
}
