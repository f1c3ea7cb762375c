/* Added to the page of the viewer: levels of detail, and files that are dropped or chosen and uploaded. */

/* Large clouds and sets of lines come in random order. Of these only a first part is drawn while the view moves, as
 * much as the renderer draws at 20 frames a second; at rest ten times as much, which is all of it but in software. */
(() => {
  const gl = WebGL2RenderingContext.prototype;
  const [FRAME_MS, AT_REST, IDLE, LEAST, FRUSTUM] = [45, 10, 10, 6000, { points: 200, vertices: 24 }]; // a frustum costs as much as 200 points
  const state = { limit: 20000, most: 0, drawn: 0, idle: 0, before: 0 };

  function cut(mode, count) {
    state.most ||= 1;
    if (mode !== gl.POINTS && mode !== gl.LINES) return count;
    const unit = mode === gl.POINTS ? 1 : FRUSTUM.vertices / FRUSTUM.points;
    state.most = Math.max(state.most, count / unit);
    const most = state.limit * (state.idle >= IDLE ? AT_REST : 1);
    return Math.min(count, mode === gl.POINTS ? Math.max(LEAST, most) : FRUSTUM.vertices * Math.ceil(most / FRUSTUM.points));
  }
  for (const [name, at] of [["drawArrays", 2], ["drawElements", 1]]) {
    const draw = gl[name];
    gl[name] = function (...words) {
      words[at] = Math.floor(cut(words[0], words[at]));
      draw.apply(this, words);
    };
  }
  requestAnimationFrame(function tick(now) {
    // Frames that follow a pause still wait for what was drawn in it.
    if (state.most && state.drawn > 2) {
      const factor = Math.max(0.5, Math.min(1.15, Math.sqrt(FRAME_MS / (now - state.before))));
      if (factor < 1 || state.most > state.limit) state.limit = Math.max(LEAST, Math.min(state.limit, state.most) * factor);
    }
    [state.drawn, state.idle] = state.most ? [state.drawn + 1, 0] : [0, state.idle + 1];
    [state.most, state.before] = [0, now];
    requestAnimationFrame(tick);
  });
  // Smooth edges take four times as long where there is no GPU.
  const probe = document.createElement("canvas").getContext("webgl2");
  const renderer = probe?.getParameter(probe.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? probe.RENDERER) ?? "";
  if (/swiftshader|llvmpipe|software/i.test(renderer)) {
    const get = HTMLCanvasElement.prototype.getContext;
    HTMLCanvasElement.prototype.getContext = function (kind, options) {
      return get.call(this, kind, /^webgl/.test(kind) ? { ...options, antialias: false } : options);
    };
  }
  probe?.getExtension("WEBGL_lose_context")?.loseContext();
})();

(() => {
  const bar = document.createElement("div");
  bar.id = "upload-progress";
  bar.style.cssText =
    "position:fixed;left:50%;top:16px;transform:translateX(-50%);z-index:9999;padding:10px 16px;border-radius:8px;" +
    "color:#fff;font:14px system-ui,sans-serif;max-width:80vw;display:none;white-space:pre-wrap";
  bar.addEventListener("click", () => say(""));
  document.addEventListener("DOMContentLoaded", () => document.body.append(bar));
  document.title = "torchslam";

  function say(words, isError) {
    bar.textContent = isError ? `${words}\n(click to close)` : words;
    bar.style.background = isError ? "#991b1b" : "#1f2937";
    bar.style.display = words ? "block" : "none";
  }

  /** Ask the server, and say what it does meanwhile; XMLHttpRequest reports the progress of an upload, fetch does not. */
  function ask(method, address, body = null, progress = () => {}) {
    return new Promise((resolve, reject) => {
      const request = new XMLHttpRequest();
      request.open(method, address);
      request.responseType = "json";
      request.upload.onprogress = progress;
      request.onload = () => {
        if (request.status < 300) resolve(request.response);
        else reject(new Error(request.response?.error ?? `the server answers ${request.status}`));
      };
      request.onerror = () => reject(new Error("the connection was lost"));
      request.send(body);
    });
  }

  async function upload(files, kind) {
    const all = [...files].sort((a, b) => a.name.localeCompare(b.name, undefined, { numeric: true }));
    const what = all.length === 1 ? all[0].name : `${all.length} files`;
    const progress = ({ loaded, total }) =>
      say(`${what}: ${loaded < total ? `${Math.floor((100 * loaded) / total)} % uploaded` : "reading it ..."}`);
    try {
      const { id } = await ask("POST", "/uploads", JSON.stringify(all.map(({ name, size }) => [name, size])));
      await ask("PUT", `/uploads/${id}?kind=${kind}`, new Blob(all), progress);
      say("");
    } catch (error) {
      say(`${what}: ${error.message}`, true);
    }
  }

  document.addEventListener("change", ({ target }) => {
    if (!target.matches?.("input[type=file][data-kind]") || !target.files.length) return;
    upload(target.files, target.dataset.kind);
    target.value = "";
  });
  for (const name of ["dragover", "drop"])
    document.addEventListener(name, (event) => {
      if (!event.dataTransfer?.types.includes("Files")) return;
      event.preventDefault();
      if (event.dataTransfer.files.length) upload(event.dataTransfer.files, "recording");
    });
  document.addEventListener("click", async ({ target }) => {
    const { take, address } = target.closest?.("a[data-take]")?.dataset ?? {};
    if (!take) return;
    say(`writing ${take} ...`); // it is written on demand
    try {
      const { address: href } = await ask("POST", address);
      Object.assign(document.createElement("a"), { href, download: "" }).click();
      say("");
    } catch (error) {
      say(`${take}: ${error.message}`, true);
    }
  });
})();
