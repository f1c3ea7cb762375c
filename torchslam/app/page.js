/* Added to the page of the viewer: files are dropped or chosen, and uploaded piece by piece, with their progress. */
(() => {
  const bar = document.createElement("div");
  bar.id = "upload-progress";
  bar.style.cssText =
    "position:fixed;left:50%;top:16px;transform:translateX(-50%);z-index:9999;padding:10px 16px;border-radius:8px;" +
    "background:#1f2937;color:#fff;font:14px system-ui,sans-serif;max-width:80vw;display:none;white-space:pre-wrap";
  const say = (words, isError) => {
    bar.textContent = words;
    bar.style.background = isError ? "#991b1b" : "#1f2937";
    bar.style.display = words ? "block" : "none";
  };
  bar.addEventListener("click", () => say(""));
  document.addEventListener("DOMContentLoaded", () => document.body.append(bar));
  document.title = "torchslam";

  async function ask(method, address, body) {
    const answer = await fetch(address, { method, body });
    const content = await answer.json().catch(() => ({ error: `the server answers ${answer.status}` }));
    if (!answer.ok) throw new Error(content.error);
    return content;
  }

  /** Send one file; XMLHttpRequest reports its progress, fetch does not. */
  function send(address, file, progress) {
    return new Promise((resolve, reject) => {
      const request = new XMLHttpRequest();
      request.open("PUT", address);
      request.responseType = "json";
      request.upload.onprogress = (event) => progress(event.loaded);
      request.onload = () =>
        request.status < 300 ? resolve() : reject(new Error(request.response?.error ?? `status ${request.status}`));
      request.onerror = () => reject(new Error("the connection was lost"));
      request.send(file);
    });
  }

  async function upload(files, kind) {
    const all = [...files].sort((a, b) => a.name.localeCompare(b.name, undefined, { numeric: true }));
    const total = all.reduce((sum, file) => sum + file.size, 0);
    const what = all.length === 1 ? all[0].name : `${all.length} files`;
    try {
      const { id } = await ask("POST", `/uploads?size=${total}&count=${all.length}`);
      let before = 0;
      for (const [position, file] of all.entries()) {
        const progress = (bytes) => say(`${what}: ${Math.floor((100 * (before + bytes)) / Math.max(1, total))} % uploaded`);
        progress(0);
        await send(`/uploads/${id}/${position}?name=${encodeURIComponent(file.name)}`, file, progress);
        before += file.size;
      }
      say(`${what}: reading it ...`);
      await ask("POST", `/uploads/${id}/end?kind=${kind}`);
      say("");
    } catch (error) {
      say(`${what}: ${error.message}\n(click to close)`, true);
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
      if (name === "drop" && event.dataTransfer.files.length) upload(event.dataTransfer.files, "recording");
    });
  document.addEventListener("click", async ({ target }) => {
    const link = target.closest?.("a[data-take]");
    if (!link) return;
    // The file is written on demand: say so, and show the message if it cannot be.
    say(`writing ${link.dataset.take} ...`);
    try {
      const { address } = await ask("POST", link.dataset.address);
      say("");
      const download = document.createElement("a");
      download.href = address;
      download.download = "";
      download.click();
    } catch (error) {
      say(`${link.dataset.take}: ${error.message}\n(click to close)`, true);
    }
  });
})();
