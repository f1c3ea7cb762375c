/* What there is to draw of a submap, from the arrays of the page. */

const RAMP = [[42, 157, 143], [138, 190, 120], [233, 196, 106], [231, 140, 90], [209, 73, 91]]; // no error to the most
const STATES = ["initializing", "tracking", "uncertain", "lost"];
const TYPES = { float64: Float64Array, float32: Float32Array, int32: Int32Array, int8: Int8Array, uint16: Uint16Array, uint8: Uint8Array };

/** The numbers of an array that was written as base64. */
function decode({ type, data }) {
  const text = atob(data);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return new TYPES[type](bytes.buffer);
}

/** The same with every array decoded. */
function decodeAll(value) {
  if (Array.isArray(value)) return value.map(decodeAll);
  if (value === null || typeof value !== "object") return value;
  if (value.data !== undefined && value.type in TYPES) return decode(value);
  return Object.fromEntries(Object.entries(value).map(([name, inner]) => [name, decodeAll(inner)]));
}

/** The color (r, g, b) of an error between 0 and `most`. */
function rampColor(error, most) {
  const at = Math.max(0, Math.min(1, error / most)) * (RAMP.length - 1);
  const low = Math.min(Math.floor(at), RAMP.length - 2);
  return RAMP[low].map((value, i) => Math.round(value + (at - low) * (RAMP[low + 1][i] - value)));
}

/** The error that is drawn as the most: all but the worst two in a hundred lie below. */
function mostOf(values) {
  const known = Array.from(values).filter(Number.isFinite).sort((a, b) => a - b);
  return known.length ? known[Math.floor(0.98 * (known.length - 1))] || 1e-12 : NaN;
}

/** Ends of the lines between consecutive rows of 3, without those that span a gap; and the row that each ends in. */
function pathLines(positions, isGap) {
  const ends = [];
  const rows = [];
  for (let row = 1; row < positions.length / 3; row++) {
    if (isGap(row)) continue;
    ends.push(...positions.subarray(3 * row - 3, 3 * row + 3));
    rows.push(row);
  }
  return { ends: new Float32Array(ends), rows };
}

/** The eight edges of the pyramid from a camera's center to its image. pose: 3 rows of 4, camera to world. */
function frustumLines(pose, corners, depth) {
  const place = ([x, y, z]) => [0, 4, 8].map((row) => pose[row] * x + pose[row + 1] * y + pose[row + 2] * z + pose[row + 3]);
  const image = corners.map((corner) => place(corner.map((value) => value * depth)));
  const center = place([0, 0, 0]);
  return image.flatMap((corner, i) => [...center, ...corner, ...corner, ...image[(i + 1) % 4]]);
}

/** Positions (3 a row) of poses (12 a row). */
function positionsOf(poses) {
  return Float32Array.from({ length: poses.length / 4 }, (_, i) => poses[12 * Math.floor(i / 3) + 4 * (i % 3) + 3]);
}

/** Positions (3 a row) of a dense cloud, whose points are whole numbers of steps from its lowest corner. */
function densePositions({ low, step, points }) {
  return Float32Array.from(points, (value, i) => low[i % 3] + value * step[i % 3]);
}

/** A grid on the floor below everything: ends, and how long the side of a square is. */
function gridLines([low, high]) {
  const extent = Math.max(high[0] - low[0], high[1] - low[1], 1e-9);
  const power = 10 ** Math.floor(Math.log10(extent / 6));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((side) => side >= extent / 12);
  const [left, front] = [0, 1].map((i) => Math.floor(low[i] / step) * step);
  const [right, back] = [0, 1].map((i) => Math.ceil(high[i] / step) * step);
  const ends = [];
  for (let x = left; x <= right + step / 2; x += step) ends.push(x, front, low[2], x, back, low[2]);
  for (let y = front; y <= back + step / 2; y += step) ends.push(left, y, low[2], right, y, low[2]);
  return { ends: new Float32Array(ends), step };
}

/** A color (r, g, b, opacity) for each of n lines. */
function colors(count, color, opacity = 255) {
  const bytes = new Uint8Array(4 * count);
  for (let i = 0; i < count; i++) bytes.set([...(typeof color === "function" ? color(i) : color), opacity], 4 * i);
  return bytes;
}

/** A length in words. */
function length(value, unit) {
  if (!Number.isFinite(value)) return "unknown";
  if (unit === "m" && value < 0.01) return `${Number((1e3 * value).toPrecision(2))} mm`;
  if (unit === "m" && value < 1) return `${Number((1e2 * value).toPrecision(3))} cm`;
  return `${Number(value.toPrecision(3))} ${unit || (value === 1 ? "map unit" : "map units")}`;
}

/** How many of the ascending values are not above a limit. */
function countUpTo(values, limit) {
  let [low, high] = [0, values.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (values[middle] <= limit) low = middle + 1;
    else high = middle;
  }
  return low;
}
