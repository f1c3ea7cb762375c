/* Added to the page of the viewer: files are dropped or chosen, and uploaded with their progress. */
(() => {
  const bar = document.createElement("div");
  bar.id = "upload-progress";
  bar.style.cssText =
    "position:fixed;left:50%;top:16px;transform:translateX(-50%);z-index:9999;padding:10px 16px;border-radius:8px;" +
    "color:#fff;font:14px system-ui,sans-serif;max-width:80vw;display:none;white-space:pre-wrap";
  bar.addEventListener("click", () => say(""));
  document.addEventListener("DOMContentLoaded", () => document.body.append(bar));
  document.title = "torchslam";

  // The viewer has no options for its resolution, and for its empty background, which takes half of a frame on a CPU.
  const beginning = setInterval(() => {
    const { backgroundMaterial, scene } = window.__viserMutable ?? {};
    const store = scene?.__r3f?.root;
    if (!store || !backgroundMaterial) return;
    clearInterval(beginning);
    backgroundMaterial.visible = false;
    detail.changed = ({ viewport, setDpr } = store.getState()) => {
      const dpr = detail.scale * Math.min(devicePixelRatio, 2);
      if (viewport.dpr !== dpr) setDpr(dpr);
    };
    store.subscribe(detail.changed); // the viewer also lowers it by itself
  }, 100);

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
