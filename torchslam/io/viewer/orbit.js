/* The eye that looks at the scene: it turns around a target in a world whose z is up. */

const FIELD_OF_VIEW = Math.PI / 4; // from top to bottom
const STEEPEST = Math.PI / 2 - 1e-3;

const STILL = 5; // pixels that a click may move; a finger twice as many

/** The eye, moved by mouse, pen and fingers on the canvas.
 *
 * `changed` is called after each move, `moved` when the target moved by hand, `tapped` after a click that moved nothing.
 */
function createEye(canvas, changed, moved, tapped) {
  const eye = { yaw: 0, pitch: 0, distance: 1, target: [0, 0, 0] };

  eye.look = (view) => {
    Object.assign(eye, view);
    changed();
  };
  eye.turn = (yaw, pitch) => {
    eye.yaw += yaw;
    eye.pitch = Math.max(-STEEPEST, Math.min(STEEPEST, eye.pitch + pitch));
    changed();
  };
  /** Come nearer by a factor below 1; what is under the pixel (x, y) from the middle stays there. */
  eye.zoom = (factor, x = 0, y = 0) => {
    const before = eye.distance;
    eye.distance = Math.max(1e-6, before * factor);
    eye.shift(x * (1 - eye.distance / before), y * (1 - eye.distance / before), before);
  };
  /** Move the target by pixels to the right and down, at a distance. */
  eye.shift = (x, y, distance = eye.distance) => {
    const unit = (2 * Math.tan(FIELD_OF_VIEW / 2) * distance) / canvas.clientHeight;
    const { right, up } = axes();
    eye.target = eye.target.map((value, i) => value + unit * (x * right[i] - y * up[i]));
    changed();
  };
  /** World to clip coordinates, and how near things may come. */
  eye.projection = () => {
    const { right, up, back } = axes();
    const position = eye.target.map((value, i) => value + eye.distance * back[i]);
    const near = eye.distance / 200;
    const far = eye.distance * 200;
    const f = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const aspect = canvas.clientWidth / canvas.clientHeight;
    const rows = [
      right.map((value) => (value * f) / aspect),
      up.map((value) => value * f),
      back.map((value) => (value * (far + near)) / (near - far)),
      back.map((value) => -value),
    ];
    const offsets = rows.map((row) => -(row[0] * position[0] + row[1] * position[1] + row[2] * position[2]));
    offsets[2] += (2 * far * near) / (near - far);
    const matrix = [0, 1, 2].flatMap((column) => rows.map((row) => row[column])).concat(offsets);
    return { matrix, near };
  };

  function axes() {
    const [cy, sy, cp, sp] = [Math.cos(eye.yaw), Math.sin(eye.yaw), Math.cos(eye.pitch), Math.sin(eye.pitch)];
    return { right: [-sy, cy, 0], up: [-sp * cy, -sp * sy, cp], back: [cp * cy, cp * sy, sp] };
  }

  const held = new Map(); // pointers by their id
  const middle = (points) => [0, 1].map((i) => points.reduce((sum, point) => sum + point[i], 0) / points.length);
  const spread = ([a, b]) => (b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0);

  let pressed = null; // where the only pointer went down, until it moves

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.clientX, event.clientY]);
    pressed = held.size === 1 && event.button === 0 && !event.shiftKey ? [event.clientX, event.clientY] : null;
  });
  for (const name of ["pointerup", "pointercancel"])
    canvas.addEventListener(name, (event) => {
      held.delete(event.pointerId);
      if (pressed && name === "pointerup") tapped(event);
      pressed = null;
    });
  canvas.addEventListener("pointermove", (event) => {
    if (!held.has(event.pointerId)) return;
    const still = event.pointerType === "mouse" ? STILL : 2 * STILL;
    if (pressed && spread([pressed, [event.clientX, event.clientY]]) <= still) return;
    pressed = null;
    const before = [...held.values()];
    held.set(event.pointerId, [event.clientX, event.clientY]);
    const after = [...held.values()];
    const [x0, y0] = middle(before);
    const [x1, y1] = middle(after);
    const moves = held.size > 1 || event.shiftKey || (event.buttons & 6) !== 0;
    if (moves) {
      moved();
      eye.shift(x0 - x1, y0 - y1);
    } else eye.turn(-(x1 - x0) * 0.006, (y1 - y0) * 0.006);
    if (held.size > 1 && spread(after) > 0) eye.zoom(spread(before) / spread(after));
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode === 1 ? 16 : event.deltaMode === 2 ? 400 : 1);
      const box = canvas.getBoundingClientRect();
      const at = [event.clientX - box.left - box.width / 2, event.clientY - box.top - box.height / 2];
      eye.zoom(Math.exp(Math.max(-200, Math.min(200, pixels)) * 0.0015), ...at);
    },
    { passive: false },
  );
  return eye;
}
