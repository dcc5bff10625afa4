// The state of the page in its address, and files of the picture and of the view.

const SETTINGS = "#controls input[id]:not([type=file], #time)";
const valueOf = (input) => (input.type === "checkbox" ? String(Number(input.checked)) : input.value);

// Restore the view, the key views and the settings from the address, and keep the address up to date.
function initState(page) {
  const inputs = [...document.querySelectorAll(SETTINGS)];
  const initial = new Map(inputs.map((input) => [input, valueOf(input)]));
  const state = new URLSearchParams(location.hash.slice(1));
  for (const input of inputs.filter(({ id }) => state.has(id))) {
    if (input.type === "checkbox") input.checked = state.get(input.id) === "1";
    else input.value = state.get(input.id);
    if (input.type === "range") $(`${input.id}-value`).value = Number(input.value).toFixed(2);
  }
  const viewsIn = (name) => {
    const numbers = (state.get(name) ?? "").split(",").map(Number);
    const views = Array.from({ length: numbers.length / 7 }, (_, i) => numbers.slice(7 * i, 7 * i + 7));
    return views.filter((view) => view.every(Number.isFinite) && view[2] > 0 && view[6] > 0);
  };
  for (const view of viewsIn("view")) page.orbit.setNumbers(view);
  page.film.setKeys(viewsIn("keys"));
  const shown = page.scene.cameras.findIndex(({ name }) => name === state.get("shown"));
  if (shown >= 0) page.show(shown);
  if (state.has("difference") && !$("difference").disabled) page.setDifference(true);
  if (state.has("turn") && !matchMedia("(prefers-reduced-motion: reduce)").matches) page.setMotion(turntable(page));

  const write = () => {
    const short = (numbers) => numbers.map((x) => Number(x.toPrecision(6)));
    const next = new URLSearchParams({ view: short(page.orbit.numbers()) });
    if (page.film.keys.length) next.set("keys", short(page.film.keys.flat()));
    if (page.isDifference) next.set("difference", 1);
    if (page.motion?.button === "turn") next.set("turn", 1);
    if (page.camera !== null) next.set("shown", page.scene.cameras[page.camera].name);
    for (const input of inputs) if (valueOf(input) !== initial.get(input)) next.set(input.id, valueOf(input));
    history.replaceState(null, "", `#${next.toString().replaceAll("%2C", ",")}`);
  };
  if (location.protocol === "about:") return; // in a frame with `srcdoc`, which has no address
  page.writeAddress = write;
  let timer = null;
  page.onChange = () => {
    clearTimeout(timer);
    timer = setTimeout(write, 400);
  };
}

function initSaving(page) {
  const download = (name, blob) => {
    const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  };
  const saveViews = (name, views, more) => {
    const text = JSON.stringify({ ...cameraFile(views, page.scene.origin), ...more }, null, 1);
    download(name, new Blob([text], { type: "application/json" }));
  };
  $("save-picture").addEventListener("click", () => {
    page.tracer.show(); // the browser clears the canvas between frames
    page.tracer.canvas.toBlob((blob) => download("picture.png", blob));
  });
  $("save-view").addEventListener("click", () => saveViews("view.json", [page.view]));
  $("save-film").addEventListener("click", () => {
    const views = page.film.views();
    saveViews("film.json", views, { seconds: views.length / FRAME_RATE });
  });
  $("copy-code").hidden = window !== window.top; // a frame may not write to the clipboard
  $("copy-code").addEventListener("click", async () => {
    page.writeAddress();
    const code = frameCode();
    const copied = await navigator.clipboard?.writeText(code).then(() => true, () => false);
    if (copied) $("notice").textContent = "The code is on the clipboard.";
    else prompt("Copy this code:", code);
  });
  $("full-screen").hidden = !document.fullscreenEnabled;
  $("full-screen").addEventListener("click", () =>
    document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen());
}

// Return views of one size in the form of `transforms.json`, which `nerfro.render path=FILE` reads.
function cameraFile(views, origin) {
  const frames = views.map(({ eye, axes, focal, principal }) => {
    const rows = [0, 1, 2].map((i) => [axes[i], axes[3 + i], axes[6 + i], eye[i] + origin[i]]);
    return { fl_x: focal[0], fl_y: focal[1], cx: principal[0], cy: principal[1], transform_matrix: [...rows, [0, 0, 0, 1]] };
  });
  return { w: views[0].size[0], h: views[0].size[1], frames };
}

// Return the HTML that shows this page in its present state in a frame of another page. A file is named relative to it.
function frameCode() {
  const frame = document.createElement("iframe");
  const src = location.protocol === "file:" ? location.href.slice(location.href.lastIndexOf("/") + 1) : location.href;
  Object.assign(frame, { src, title: document.title, width: "100%", height: 500, loading: "lazy", allowFullscreen: true });
  return frame.outerHTML;
}
