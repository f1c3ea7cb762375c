/* The ruler: two points of the map, the distance between them, and the option that says how long it is in truth. */

const PIXEL_STEPS = 65535; // of an image point, over the image
const REACH = 14; // pixels from a click to the point that it means; twice as many for a finger
const BESIDE = 3; // pixels that a point nearer to the eye may be farther from the click

/** Row of the point that is seen at a pixel of the canvas, -1 if none is within reach: near to it, and near to the eye. */
function pointAt(positions, { matrix: m, near }, [width, height], [x, y], reach) {
  let [best, least] = [-1, Infinity];
  for (let row = 0, at = 0; at < positions.length; row++, at += 3) {
    const [px, py, pz] = [positions[at], positions[at + 1], positions[at + 2]];
    const depth = m[3] * px + m[7] * py + m[11] * pz + m[15];
    if (depth < near) continue;
    const right = ((m[0] * px + m[4] * py + m[8] * pz + m[12]) / depth + 1) * (width / 2) - x;
    const down = (1 - (m[1] * px + m[5] * py + m[9] * pz + m[13]) / depth) * (height / 2) - y;
    const pixels = Math.hypot(right, down);
    const cost = (pixels + BESIDE) * depth;
    if (pixels <= reach && cost < least) [best, least] = [row, cost];
  }
  return best;
}

/** Variance of a point along a direction of unit length; NaN where it is unknown. */
function varianceAlong(submap, row, direction) {
  const step = new Float32Array(new Uint32Array([submap.error_step[row] << 16]).buffer)[0]; // of a float, the upper half
  if (!(step > 0)) return NaN;
  const [xx, yx, yy, zx, zy, zz] = submap.error_factor.subarray(6 * row, 6 * row + 6);
  const [x, y, z] = direction;
  return step ** 2 * ((xx * x + yx * y + zx * z) ** 2 + (yy * y + zy * z) ** 2 + (zz * z) ** 2);
}

/** Distance of two points and its standard error, by the errors of both and of the unit; NaN where it is unknown. */
function distanceOf(submap, first, second) {
  const between = [0, 1, 2].map((i) => submap.points[3 * second + i] - submap.points[3 * first + i]);
  const value = Math.hypot(...between);
  const direction = between.map((part) => part / (value || 1));
  const variances = [first, second].map((row) => varianceAlong(submap, row, direction));
  return { value, std: Math.sqrt(variances[0] + variances[1] + (value * submap.unit_std) ** 2) };
}

/** A length in words, to two digits of its standard error. */
function lengthAndError({ value, std }, unit) {
  if (!(std > 0)) return length(value, unit);
  const digits = Math.max(0, Math.min(9, 1 - Math.floor(Math.log10(std))));
  return `${value.toFixed(digits)} ± ${std.toFixed(digits)} ${unit || "map units"}`;
}

/** FRAME:X,Y of a point, null if no frame of the run shows it. */
function clickOf(submap, row, size) {
  if (submap.seen_frame[row] < 0) return null;
  const pixel = [0, 1].map((i) => (submap.seen_pixel[2 * row + i] * (size[i] - 1)) / PIXEL_STEPS);
  return `${submap.seen_frame[row]}:${pixel.map((value) => Number(value.toFixed(1)))}`;
}

/** The command that takes the distance of two clicks for a number of meters. */
function alignCommand(folder, clicks, meters) {
  const plain = /^[\w@%+=:,./~-]+$/;
  const word = plain.test(folder) ? folder : `'${folder.replaceAll("'", "'\\''")}'`;
  return `torchslam align ${word} --distance ${clicks.join(" ")} ${meters}`;
}

/** The folder that a page was opened from; DIR where that is no folder of this computer. */
function folderOf({ protocol, pathname }) {
  if (protocol !== "file:") return "DIR";
  const folder = decodeURIComponent(pathname).replace(/\/[^/]*$/, "") || "/";
  return folder.replace(/^\/([A-Za-z]:)/, "$1"); // a drive
}

/** A positive number of meters in the words of a user; METERS, to be replaced, if it is none. */
function metersIn(text) {
  const words = text.trim().replace(",", ".");
  return /^\d*\.?\d+$/.test(words) && Number(words) > 0 ? words : "METERS";
}

/** The panel of the ruler, and the points that were taken. `changed` is called where something else is to be drawn. */
function createRuler(size, changed) {
  const part = (name) => document.getElementById(`ruler${name && "-" + name}`);
  const ruler = { isOn: false, rows: [], preview: -1, submap: null };

  function command() {
    const clicks = ruler.rows.map((row) => clickOf(ruler.submap, row, size));
    return alignCommand(folderOf(location), clicks, metersIn(part("meters").value));
  }

  function tell(words) {
    const isWhole = ruler.rows.length === 2;
    const isShown = isWhole && ruler.rows.every((row) => ruler.submap.seen_frame[row] >= 0);
    part("").hidden = !ruler.isOn;
    part("option").hidden = !isShown;
    part("copy").textContent = "Copy";
    if (isShown) part("command").textContent = command();
    if (isWhole) {
      const { unit, unit_std } = ruler.submap;
      words = lengthAndError(distanceOf(ruler.submap, ...ruler.rows), unit);
      if (unit === "m" && !unit_std) words += ", scaled by the ground truth";
      if (!isShown) words += ". No frame of this run shows both points.";
    }
    part("words").textContent = words;
    changed();
  }

  const ask = () => tell(ruler.rows.length === 1 ? "Click the second point." : "Click a point of the map.");

  /** Switch it on or off, and forget the points. */
  ruler.set = (isOn, submap) => {
    Object.assign(ruler, { isOn, submap, rows: [], preview: -1 });
    part("meters").value = "";
    document.body.classList.toggle("measuring", isOn);
    ask();
  };
  /** Take a point; after two, another one is the first again. */
  ruler.take = (row) => {
    if (row < 0) return tell("There is no point.");
    if (ruler.rows.length === 2) ruler.rows = [];
    if (ruler.rows[0] === row) return tell("This is the first point. Click another one.");
    ruler.rows.push(row);
    ruler.preview = -1;
    ask();
  };
  /** Show where the second point would be. */
  ruler.hover = (row) => {
    if (ruler.preview === row) return;
    ruler.preview = row;
    changed();
  };
  /** The rows of the points to mark: those taken, and where the pointer is. */
  ruler.marks = () => (ruler.rows.length < 2 && ruler.preview >= 0 ? [...ruler.rows, ruler.preview] : ruler.rows);

  part("meters").addEventListener("input", () => (part("command").textContent = command()));
  part("copy").addEventListener("click", async () => {
    getSelection().selectAllChildren(part("command")); // to be copied by hand where the browser refuses
    const isCopied = await navigator.clipboard.writeText(command()).then(() => true, () => document.execCommand("copy"));
    part("copy").textContent = isCopied ? "Copied" : "Not copied";
  });
  return ruler;
}
