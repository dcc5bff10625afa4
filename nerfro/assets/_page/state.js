// The state of the page in its address, and files of the picture and of the view.

const SETTINGS = "#controls input[id]:not([type=file])";
const valueOf = (input) => (input.type === "checkbox" ? String(Number(input.checked)) : input.value);

// Restore the view and the settings from the address, and keep the address up to date.
function initState(page) {
  const inputs = [...document.querySelectorAll(SETTINGS)];
  const initial = new Map(inputs.map((input) => [input, valueOf(input)]));
  const state = new URLSearchParams(location.hash.slice(1));
  for (const input of inputs.filter(({ id }) => state.has(id))) {
    if (input.type === "checkbox") input.checked = state.get(input.id) === "1";
    else input.value = state.get(input.id);
    if (input.type === "range") $(`${input.id}-value`).value = Number(input.value).toFixed(2);
  }
  const numbers = (state.get("view") ?? "").split(",").map(Number);
  if (numbers.length === 7 && numbers.every(Number.isFinite)) page.orbit.setNumbers(numbers);
  const shown = page.scene.cameras.findIndex(({ name }) => name === state.get("shown"));
  if (shown >= 0) page.show(shown);

  const write = () => {
    const next = new URLSearchParams({ view: page.orbit.numbers().map((x) => Number(x.toPrecision(6))) });
    if (page.camera !== null) next.set("shown", page.scene.cameras[page.camera].name);
    for (const input of inputs) if (valueOf(input) !== initial.get(input)) next.set(input.id, valueOf(input));
    history.replaceState(null, "", `#${next.toString().replaceAll("%2C", ",")}`);
  };
  if (location.protocol === "about:") return; // in a frame with `srcdoc`, which has no address
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
  $("save-picture").addEventListener("click", () => {
    page.tracer.show(); // the browser clears the canvas between frames
    page.tracer.canvas.toBlob((blob) => download("picture.png", blob));
  });
  $("save-view").addEventListener("click", () => {
    const text = JSON.stringify(cameraFile(page.view, page.scene.origin), null, 1);
    download("view.json", new Blob([text], { type: "application/json" }));
  });
  $("full-screen").hidden = !document.fullscreenEnabled;
  $("full-screen").addEventListener("click", () =>
    document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen());
}

// Return the view in the form of `transforms.json`, which `nerfro.render path=FILE` reads.
function cameraFile({ eye, axes, focal, principal, size }, origin) {
  const rows = [0, 1, 2].map((i) => [axes[i], axes[3 + i], axes[6 + i], eye[i] + origin[i]]);
  return {
    w: size[0], h: size[1], fl_x: focal[0], fl_y: focal[1], cx: principal[0], cy: principal[1],
    frames: [{ transform_matrix: [...rows, [0, 0, 0, 1]] }],
  };
}
