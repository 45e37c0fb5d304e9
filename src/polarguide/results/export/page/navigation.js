/** The camera: a pose with the intrinsics of a photograph, orbiting a pivot. */
class Navigation {
  constructor(scene) {
    this.scene = scene;
    this.open();
  }

  /** The first photograph's place, aimed at the subject. */
  open() {
    this.stand(this.scene.cameras[this.scene.first]);
    const { center, up } = this.scene, ahead = unit(add(center, this.eye, -1));
    const right = cross(ahead, up);
    if (dot(ahead, this.rotation.slice(6)) < 0.5 || Math.hypot(...right) < 0.1) return;
    this.rotation = [...unit(right), ...cross(ahead, unit(right)), ...ahead];
    this.pivot = center;
    this.filling = true;
  }

  /** Move to the pose of a photograph. */
  stand(camera) {
    this.lens = camera;
    this.filling = false;
    this.rotation = camera.rotation;
    this.eye = scaled(apply(transposed(camera.rotation), camera.translation), -1);
    const ahead = dot(add(this.scene.center, this.eye, -1), this.rotation.slice(6));
    this.pivot = add(this.eye, this.rotation.slice(6), Math.max(ahead, 0.1 * this.scene.distance));
  }

  /** Orbit the pivot by angles about the up axis and the right axis. */
  orbit(around, over) {
    const right = this.rotation.slice(0, 3), up = this.scene.up;
    let turn = product(turning(up, around), turning(right, over));
    const forward = apply(turn, this.rotation.slice(6));
    if (Math.abs(dot(forward, up)) > 0.98) turn = turning(up, around);
    this.rotation = product(this.rotation, transposed(turn));
    this.rotation = [0, 1, 2].flatMap((k) => unit(this.rotation.slice(3 * k, 3 * k + 3)));
    this.eye = add(this.pivot, apply(turn, add(this.eye, this.pivot, -1)));
  }

  zoom(factor) {
    const away = add(this.eye, this.pivot, -1), far = Math.hypot(...away) * factor;
    if (far < 0.02 * this.scene.distance || far > 50 * this.scene.distance) return;
    this.eye = add(this.pivot, away, factor);
  }

  /** Pan camera and pivot by a share of the picture's height. */
  pan(right, down) {
    const far = Math.hypot(...add(this.eye, this.pivot, -1)) * this.lens.height / this.lens.fy;
    const shift = add(scaled(this.rotation.slice(0, 3), -right * far), this.rotation.slice(3, 6), -down * far);
    this.eye = add(this.eye, shift);
    this.pivot = add(this.pivot, shift);
  }

  /**
   * The camera for a picture size: the photograph's intrinsics, scaled so that the whole photograph is visible. An
   * upright picture opens on the photograph's middle instead: a phone shows the subject, not a strip of it.
   */
  camera(width, height) {
    const { lens, rotation } = this, sides = [width / lens.width, height / lens.height];
    const whole = Math.min(...sides), upright = this.filling && sides[0] < sides[1];
    const factor = upright ? Math.min(sides[1], 1.7 * whole) : whole;
    return {
      width, height, rotation,
      translation: scaled(apply(rotation, this.eye), -1),
      fx: lens.fx * factor, fy: lens.fy * factor,
      cx: (lens.cx - lens.width / 2) * factor + width / 2,
      cy: (lens.cy - lens.height / 2) * factor + height / 2,
    };
  }
}
