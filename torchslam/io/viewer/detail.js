/* Levels of detail, of view.html and of `torchslam app`.
 *
 * Large clouds, and frusta as a mesh of lines, come in random order. While the view moves, only a first part of them is
 * drawn, as much as the renderer draws in 34 ms, which gives 21 to 24 frames a second (with 40 ms: 19), on a slow one
 * with half of the resolution and without images; at rest 15 times as much with all of it, which takes below a second.
 * A GPU draws everything at any time.
 */
const detail = { scale: 1, changed() {} }; // resolution relative to that of the screen; called when to draw again
(() => {
  const gl = WebGL2RenderingContext.prototype;
  const [FRAME_MS, AT_REST, IDLE, BURST, STILL_MS] = [34, 15, 10, 5, 500];
  // Points that are drawn at least, while the view moves and at rest; with a limit below SLOW, the resolution is halved.
  const [LEAST, LEAST_AT_REST, SLOW] = [2000, 150000, 30000];
  const FRUSTUM = { vertices: 24, points: 50 }; // of its lines; points that take as long
  const IMAGE = 6; // vertices of its triangles; images are not drawn at half of the resolution
  let [limit, largest, isResting, isCut, drawn, idle, before, touched] = [40000, 0, false, false, 0, 0, -1, -Infinity];
  const isStill = (now) => drawn < BURST && now - touched > STILL_MS;

  for (const name of ["pointerdown", "pointermove", "wheel", "keydown"])
    addEventListener(name, ({ type, buttons }) => (touched = type !== "pointermove" || buttons ? performance.now() : touched), true);

  function allowed(mode, count) {
    if (before < 0) {
      before = performance.now(); // the first frame after a pause
      isResting = isStill(before);
      requestAnimationFrame(look);
    }
    const isPoints = mode === gl.POINTS;
    const points = isPoints ? count : mode === gl.LINES ? (count / FRUSTUM.vertices) * FRUSTUM.points : 1;
    largest = Math.max(largest, points);
    if (mode === gl.TRIANGLES && count === IMAGE && detail.scale < 1) return 0;
    const most = isResting ? Math.max(LEAST_AT_REST, limit * AT_REST) : limit;
    if (points <= most) return count;
    isCut = !isResting;
    return isPoints ? Math.floor(most) : FRUSTUM.vertices * Math.ceil(most / FRUSTUM.points);
  }

  /** Before each refresh of the screen, from the first frame that is drawn to some time after the last one. */
  function look(now) {
    if (largest && !isResting && drawn > 2) {
      // The frames before wait for what was drawn in the pause.
      const factor = Math.max(0.5, Math.min(1.15, Math.sqrt(FRAME_MS / (now - before))));
      if (factor < 1 || largest > limit) limit = Math.max(LEAST, Math.min(limit, largest) * factor);
      if (limit < SLOW) rescale(0.5);
    }
    idle = largest ? 0 : idle + 1;
    drawn = largest ? drawn + 1 : idle < IDLE ? drawn : 0;
    [largest, before, isResting] = [0, now, isStill(now)];
    if (idle < IDLE || now - touched <= STILL_MS) return requestAnimationFrame(look);
    before = -1;
    if (isCut) detail.changed();
    isCut = false;
    rescale(1);
  }

  function rescale(scale) {
    if (detail.scale === scale) return;
    detail.scale = scale;
    detail.changed();
  }

  for (const [name, at] of [["drawArrays", 2], ["drawElements", 1]]) {
    const draw = gl[name];
    gl[name] = function (...words) {
      words[at] = allowed(words[0], words[at]);
      if (words[at]) draw.apply(this, words);
    };
  }
  // Smooth edges take four times as long where there is no GPU.
  const probe = document.createElement("canvas").getContext("webgl2");
  const named = probe?.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL;
  if (named && /swiftshader|llvmpipe|software/i.test(probe.getParameter(named))) {
    const get = HTMLCanvasElement.prototype.getContext;
    HTMLCanvasElement.prototype.getContext = function (kind, options) {
      return get.call(this, kind, /^webgl/.test(kind) ? { ...options, antialias: false } : options);
    };
  }
  probe?.getExtension("WEBGL_lose_context")?.loseContext();
})();

/** The same points in random order. positions: 3 floats, colors: 3 bytes a point. */
function shuffled(positions, colors) {
  const [order, seed] = [Uint32Array.from({ length: positions.length / 3 }, (_, i) => i), [1]];
  for (let i = order.length - 1; i > 0; i--) {
    seed[0] = (Math.imul(seed[0], 1664525) + 1013904223) >>> 0;
    const j = Math.floor((seed[0] / 2 ** 32) * (i + 1));
    [order[i], order[j]] = [order[j], order[i]];
  }
  const rows = (values) => values.map((_, i) => values[3 * order[Math.floor(i / 3)] + (i % 3)]);
  return [rows(positions), rows(colors)];
}
