/* The page: submaps, layers, the frames in time. */

const $ = (id) => document.getElementById(id);
const data = decodeAll(JSON.parse($("data").textContent));
const frames = data.frames;
const last = frames.index.length - 1;
const dark = matchMedia("(prefers-color-scheme: dark)");
const painter = createPainter($("scene"));
const eye = createEye($("scene"), redraw, () => ($("follow").checked = false), takeAt);
const ruler = createRuler(data.size, markRuler);
const layers = {};
const shown = { submap: null, frame: last, playing: false, clock: 0, pointSize: 1, waiting: false, hadPoints: true };

const COVER = 1.5; // widths of a dense point, in distances between neighbors: surfaces are closed

const number = (value) => value.toLocaleString("en");
const tone = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const rgb = (name) => [1, 3, 5].map((i) => parseInt(tone(name).slice(i, i + 2), 16));
const isOn = (layer) => document.querySelector(`[data-layer=${layer}]`).checked;

// --- submaps and layers ---------------------------------------------------------------------------------------------

/** Row of the pose of a frame in the submap that is shown, -1 where it has none. */
function rowOf(frame) {
  const row = countUpTo(shown.submap.frame, frame) - 1;
  return row >= 0 && shown.submap.frame[row] === frame ? row : -1;
}

function showSubmap(submap) {
  shown.submap = submap;
  if (submap) {
    submap.positions ??= positionsOf(submap.poses);
    submap.most ??= mostOf(submap.errors);
    const hasErrors = Number.isFinite(submap.most);
    $("color-choice").hidden = !hasErrors;
    $("color").value = hasErrors ? "error" : "state";
    document.querySelector("[data-for=truth]").hidden = submap.truth.length === 0;
    const counted = (shown, total) => number(shown) + (shown < total ? ` of ${number(total)}` : "");
    $("count-points").textContent = counted(submap.points.length / 3, submap.points_total);
    const { dense } = submap;
    document.querySelector("[data-for=dense]").hidden = !dense;
    document.querySelector("[data-layer=points]").checked = !dense; // which has them all, and more
    if (dense) $("count-dense").textContent = counted(dense.points.length / 3, dense.total);
    $("count-path").textContent = length(submap.path_length, submap.unit);
    $("count-keyframes").textContent = number(submap.keyframe.length);
    build();
    resetView();
    if (ruler.isOn) ruler.set(true, submap);
  }
  drawStrip();
  showFrame(shown.frame);
}

/** Make all layers of the submap that is shown, in the colors of the theme. */
function build() {
  const submap = shown.submap;
  if (!submap || !painter) return;
  Object.values(layers).forEach(painter.remove);
  layers.dense = null;
  const points = submap.colors.length ? submap.colors : new Uint8Array(submap.points.length).map((_, i) => rgb("unpainted")[i % 3]);
  layers.points = painter.points(...shuffled(submap.points, points));
  if (submap.dense) layers.dense = painter.points(...shuffled(densePositions(submap.dense), submap.dense.colors));
  shown.finest = submap.points.length > 3e5 ? 1.3 : 2.6; // pixels: few points would hardly be seen
  const path = pathLines(submap.positions, (row) => submap.breaks.includes(row));
  shown.pathFrames = path.rows.map((row) => submap.frame[row]);
  layers.path = painter.lines(path.ends, colors(path.rows.length, (i) => pathColor(path.rows[i])));
  const truth = pathLines(submap.truth, () => false);
  layers.truth = painter.lines(truth.ends, colors(truth.rows.length, rgb("truth"), 190));
  const edges = [];
  for (let at = 0; at < submap.keyframe_poses.length; at += 12)
    edges.push(...frustumLines(submap.keyframe_poses.subarray(at, at + 12), data.corners, submap.frustum));
  layers.keyframes = painter.lines(new Float32Array(edges), colors(edges.length / 6, rgb("keyframe"), 150));
  const grid = gridLines(submap.box);
  layers.grid = painter.lines(grid.ends, colors(grid.ends.length / 6, rgb("grid"), 140));
  $("count-grid").textContent = length(grid.step, submap.unit) + (submap.level ? ", level" : "");
  markRuler();
  const byError = $("color").value === "error";
  $("ramp").hidden = !byError;
  $("states").hidden = byError;
  $("ramp").firstElementChild.style.background = `linear-gradient(90deg, ${RAMP.map((c) => `rgb(${c})`)})`;
  $("ramp-high").textContent = `≥ ${length(submap.most, submap.unit)}`;
}

function pathColor(row) {
  const submap = shown.submap;
  if ($("color").value === "error")
    return Number.isFinite(submap.errors[row]) ? rampColor(submap.errors[row], submap.most) : rgb("unpainted");
  const state = STATES[frames.state[submap.frame[row]]];
  return rgb(state === "tracking" || state === "uncertain" ? state : "later");
}

function currentFrustum() {
  painter.remove(layers.camera);
  layers.camera = null;
  const row = rowOf(shown.frame);
  if (row < 0) return;
  const submap = shown.submap;
  const edges = frustumLines(submap.poses.subarray(12 * row, 12 * row + 12), data.corners, 1.8 * submap.frustum);
  layers.camera = painter.lines(new Float32Array(edges), colors(8, rgb("camera")));
  if ($("follow").checked) eye.look({ target: [...submap.positions.subarray(3 * row, 3 * row + 3)] });
}

// --- drawing -------------------------------------------------------------------------------------------------------

/** Draw before the next refresh of the screen, however often it is asked for. */
function redraw() {
  if (shown.waiting || !painter) return;
  shown.waiting = true;
  requestAnimationFrame(() => {
    shown.waiting = false;
    draw();
  });
}

function draw() {
  const canvas = $("scene");
  const scale = Math.min(devicePixelRatio || 1, 2) * detail.scale;
  const size = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.round(scale * side));
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
  painter.begin(rgb("ground").map((value) => value / 255));
  const submap = shown.submap;
  if (!submap) return;
  const view = eye.projection();
  const past = { faded: 0.22, cut: countUpTo(shown.pathFrames, shown.frame) };
  const ink = rgb("ink").map((value) => value / 255);
  if (isOn("grid")) painter.draw(layers.grid, { ...view, width: scale });
  if (isOn("points"))
    painter.draw(layers.points, {
      ...view,
      size: shown.pointSize * 0.006 * submap.radius * canvas.height,
      limits: [shown.finest * scale * shown.pointSize, 7 * scale * shown.pointSize],
      lift: [...ink, 0.2],
    });
  if (submap.dense && isOn("dense"))
    painter.draw(layers.dense, {
      ...view,
      size: (shown.pointSize * COVER * submap.dense.spacing * canvas.height) / (2 * Math.tan(FIELD_OF_VIEW / 2)),
      limits: [1.2 * scale * shown.pointSize, 12 * scale * shown.pointSize],
      lift: [...ink, 0],
    });
  if (isOn("truth")) painter.draw(layers.truth, { ...view, width: 1.4 * scale });
  if (isOn("keyframes"))
    painter.draw(layers.keyframes, { ...view, width: scale, faded: 0.25, cut: 8 * countUpTo(submap.keyframe, shown.frame) });
  if (isOn("path")) painter.draw(layers.path, { ...view, width: 2.6 * scale, ...past });
  painter.draw(layers.camera, { ...view, width: 2 * scale, above: true });
  painter.draw(layers.ruler, { ...view, width: 2.4 * scale, above: true });
  painter.draw(layers.marks, { ...view, size: 0, limits: [9 * scale, 9 * scale], lift: [0, 0, 0, 0], above: true });
}

function resetView(pitch = 0.55) {
  const [low, high] = shown.submap.box;
  const isWide = high[0] - low[0] > high[1] - low[1];
  const { clientWidth: width, clientHeight: height } = $("scene");
  const free = $("time").offsetTop || height; // what the strip of frames leaves
  const distance = (0.85 * shown.submap.radius * height) / Math.tan(FIELD_OF_VIEW / 2) / Math.min(free, width);
  eye.look({ yaw: isWide ? -1.2 : -0.4, pitch, distance, target: low.map((value, i) => (value + high[i]) / 2) });
  eye.shift(0, (height - free) / 2);
}

function toggle(layer) {
  const box = document.querySelector(`[data-layer=${layer}]`);
  box.checked = !box.checked;
  redraw();
}

// --- the ruler ----------------------------------------------------------------------------------------------------

/** Switch the ruler on or off; the points that it measures between are shown. */
function measure(isOn) {
  if (!shown.submap || isOn === ruler.isOn) return;
  const points = document.querySelector("[data-layer=points]");
  if (isOn) shown.hadPoints = points.checked;
  points.checked = isOn || shown.hadPoints;
  $("measure").checked = isOn;
  ruler.set(isOn, shown.submap);
  if (isOn) $("scene").focus();
}

/** Row of the point at a pixel of the canvas. */
function rowAt(pixel, reach) {
  const { clientWidth, clientHeight } = $("scene");
  return pointAt(shown.submap.points, eye.projection(), [clientWidth, clientHeight], pixel, reach);
}

function takeAt(event) {
  if (ruler.isOn) ruler.take(rowAt([event.clientX, event.clientY], event.pointerType === "mouse" ? REACH : 2 * REACH));
}

/** Take the point at the cross in the middle of the view. */
function takeMiddle() {
  const { clientWidth, clientHeight } = $("scene");
  if (ruler.isOn) ruler.take(rowAt([clientWidth / 2, clientHeight / 2], 2 * REACH));
}

/** Forget the points of the ruler; without any, put it away. */
function cancelRuler() {
  if (ruler.rows.length) ruler.set(true, shown.submap);
  else measure(false);
}

/** Draw the marks of the ruler, and the line between them. */
function markRuler() {
  if (!painter || !shown.submap) return;
  painter.remove(layers.ruler);
  painter.remove(layers.marks);
  const ends = Float32Array.from(ruler.marks().flatMap((row) => [...shown.submap.points.subarray(3 * row, 3 * row + 3)]));
  layers.marks = painter.points(ends, Uint8Array.from(ends, (_, i) => rgb("mark")[i % 3]));
  layers.ruler = ends.length === 6 ? painter.lines(ends, colors(1, rgb("mark"))) : null;
  redraw();
}

// --- frames in time ------------------------------------------------------------------------------------------------

function showFrame(frame) {
  shown.frame = Math.max(0, Math.min(last, frame));
  $("frame").value = shown.frame;
  if (last < 0) return;
  const words = [`frame ${frames.index[shown.frame]}`, `${frames.seconds[shown.frame].toFixed(2)} s`, STATES[frames.state[shown.frame]]];
  if (shown.submap && painter) {
    const row = rowOf(shown.frame);
    if (row < 0) words.push("no pose here");
    else if (Number.isFinite(shown.submap.errors[row])) words.push(`error ${length(shown.submap.errors[row], shown.submap.unit)}`);
    currentFrustum();
  }
  if (frames.inliers[shown.frame]) words.push(`${number(frames.inliers[shown.frame])} points seen`);
  if (frames.keyframe[shown.frame]) words.push("keyframe");
  $("frame").setAttribute("aria-valuetext", words.join(", "));
  const reason = data.reasons[frames.reason[shown.frame]];
  $("readout").textContent = words.concat(reason || []).join(" · ");
  redraw();
}

/** State, and the error or the points seen, over the frames. */
function drawStrip() {
  const canvas = $("strip");
  const scale = devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  [canvas.width, canvas.height] = [width * scale, height * scale];
  const pen = canvas.getContext("2d");
  pen.scale(scale, scale);
  const x = (frame) => 1.5 + ((width - 3) * frame) / Math.max(last, 1); // as the middle of the slider's thumb goes
  const bands = { initializing: "start", lost: "lost", uncertain: "doubt" };
  for (let frame = 0, next = 0; frame <= last; frame = next) {
    while (next <= last && frames.state[next] === frames.state[frame]) next++;
    pen.fillStyle = tone(bands[STATES[frames.state[frame]]] ?? "hair");
    pen.fillRect(x(frame - 0.5), 0, x(next - 0.5) - x(frame - 0.5), height);
  }
  const submap = shown.submap;
  const hasErrors = submap && Number.isFinite(submap.most);
  const values = hasErrors ? submap.errors : frames.inliers;
  const most = hasErrors ? values.reduce((a, b) => (b > a ? b : a), 0) : Math.max(...frames.inliers, 1);
  pen.strokeStyle = tone("ink");
  pen.lineWidth = 1.2;
  pen.lineJoin = "round";
  pen.beginPath();
  let before = NaN;
  values.forEach((value, i) => {
    const frame = hasErrors ? submap.frame[i] : i;
    if (!Number.isFinite(value)) return;
    pen[frame - before === 1 ? "lineTo" : "moveTo"](x(frame), height - 2 - ((height - 5) * value) / most);
    before = frame;
  });
  pen.stroke();
  document.querySelectorAll("#curve [data-state]").forEach((word) => (word.hidden = !frames.state.includes(STATES.indexOf(word.dataset.state))));
  $("curve-words").textContent = last < 0 ? "" : hasErrors ? `error, up to ${length(most, submap.unit)}` : `points seen, up to ${number(most)}`;
}

function play(playing) {
  if (playing === shown.playing || last < 1) return;
  shown.playing = playing;
  $("play").setAttribute("aria-label", playing ? "Pause" : "Play");
  $("play").querySelector("path").setAttribute("d", playing ? "M3.5 2.5h3v11h-3zM9.5 2.5h3v11h-3z" : "M4 2.5v11l9.5-5.5z");
  if (!playing) return;
  if (shown.frame >= last) showFrame(0);
  let before = performance.now();
  shown.clock = frames.seconds[shown.frame];
  requestAnimationFrame(function tick(now) {
    if (!shown.playing) return;
    shown.clock += (Math.max(0, now - before) / 1000) * Number($("speed").value);
    before = now;
    const frame = Math.max(shown.frame, countUpTo(frames.seconds, shown.clock) - 1);
    if (frame !== shown.frame) showFrame(frame);
    if (frame >= last) play(false);
    else requestAnimationFrame(tick);
  });
}

function seek(frame) {
  play(false);
  showFrame(frame);
}

// --- the page's own controls ---------------------------------------------------------------------------------------

const KEYS = {
  " ": () => play(!shown.playing),
  ArrowLeft: (event) => seek(shown.frame - (event.shiftKey ? 10 : 1)),
  ArrowRight: (event) => seek(shown.frame + (event.shiftKey ? 10 : 1)),
  Home: () => seek(0),
  End: () => seek(last),
  w: (event) => (event.shiftKey ? eye.shift(0, -20) : eye.turn(0, 0.06)),
  s: (event) => (event.shiftKey ? eye.shift(0, 20) : eye.turn(0, -0.06)),
  a: (event) => (event.shiftKey ? eye.shift(-20, 0) : eye.turn(-0.08, 0)),
  d: (event) => (event.shiftKey ? eye.shift(20, 0) : eye.turn(0.08, 0)),
  "+": () => eye.zoom(0.9),
  "=": () => eye.zoom(0.9),
  "-": () => eye.zoom(1 / 0.9),
  p: () => toggle("points"),
  c: () => toggle("dense"),
  k: () => toggle("keyframes"),
  g: () => toggle("grid"),
  "[": () => resizePoints(0.8),
  "]": () => resizePoints(1.25),
  f: () => $("follow").click(),
  r: () => shown.submap && resetView(),
  t: () => shown.submap && resetView(STEEPEST),
  m: () => measure(!ruler.isOn),
  Enter: takeMiddle,
  Escape: cancelRuler,
  "?": () => $("help").showModal(),
};

function resizePoints(factor) {
  shown.pointSize = Math.max(0.3, Math.min(6, shown.pointSize * factor));
  redraw();
}

function listen() {
  $("frame").addEventListener("input", (event) => seek(Number(event.target.value)));
  $("play").addEventListener("click", () => play(!shown.playing));
  $("reset").addEventListener("click", KEYS.r);
  $("top").addEventListener("click", KEYS.t);
  $("help-open").addEventListener("click", KEYS["?"]);
  $("follow").addEventListener("change", () => showFrame(shown.frame));
  $("measure").addEventListener("change", (event) => measure(event.target.checked));
  $("scene").addEventListener("pointermove", (event) => {
    if (ruler.isOn && event.buttons === 0) ruler.hover(rowAt([event.clientX, event.clientY], REACH));
  });
  $("submap").addEventListener("change", (event) => showSubmap(data.submaps[event.target.value]));
  $("color").addEventListener("change", () => (build(), showFrame(shown.frame)));
  document.querySelectorAll("[data-layer]").forEach((box) => box.addEventListener("change", redraw));
  addEventListener("resize", () => (drawStrip(), redraw()));
  dark.addEventListener("change", () => (build(), drawStrip(), showFrame(shown.frame)));
  addEventListener("keydown", (event) => {
    const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const isTaken = event.ctrlKey || event.metaKey || event.altKey || $("help").open || event.target.tagName === "SELECT";
    const isPressed = /BUTTON|SUMMARY|INPUT/.test(event.target.tagName) && event.target.type !== "range";
    const presses = isPressed && (name === " " || name === "Enter");
    const types = event.target.type === "text" && name !== "Escape";
    if (isTaken || presses || types || !(name in KEYS)) return;
    event.preventDefault();
    KEYS[name](event);
  });
}

function begin() {
  detail.changed = redraw;
  $("title").textContent = data.title;
  $("facts").textContent = data.facts;
  $("frame").max = Math.max(last, 0);
  data.submaps.forEach((submap, i) => $("submap").add(new Option(submap.name, i)));
  $("submap-choice").hidden = data.submaps.length < 2;
  $("legend").open = innerWidth > 600;
  $("legend").hidden = data.submaps.length === 0;
  $("trouble").hidden = painter !== null && data.submaps.length > 0;
  $("trouble").textContent = painter ? data.failure || "There is no map." : "This browser has no WebGL 2, which draws the map.";
  listen();
  const asked = new URLSearchParams(location.hash.slice(1)); // view.html#submap=0&frame=120
  if (asked.has("frame")) shown.frame = Number(asked.get("frame")) || 0;
  const chosen = data.submaps[Number(asked.get("submap")) || 0] ?? data.submaps[0] ?? null;
  $("submap").value = data.submaps.indexOf(chosen);
  showSubmap(chosen);
  document.documentElement.dataset.ready = $("readout").textContent;
}

begin();
