// The page: controls, input on the canvas, and the loop that draws frames.

const $ = (id) => document.getElementById(id);
const MAX_RAYS = 64; // rays per pixel of a view that does not change
const MOVING_MS = 30, STILL_MS = 100; // target duration of a draft while the view changes, and of a part of a pass afterwards
const LIVE_MS = 100; // duration of drawing after an update of a training, from which a browser on the same machine takes time
const MIN_PIXELS = 2048; // of a part of a pass, because every part waits for the browser once
const SCALES = { min: 0.12, max: 1 }; // sides of a draft, as fractions of the sides of the canvas

class Page {
  constructor(scene, images) {
    this.tracer = new Tracer($("canvas"));
    this.scene = scene;
    this.images = images;
    this.tracer.load(scene, images);
    this.orbit = new Orbit(scene.orbit);
    this.camera = null; // index of the shown camera of the data set; null for the orbit
    this.maxRays = MAX_RAYS;
    this.budget = Infinity; // milliseconds of drawing until the next change
    this.motion = null; // of the orbit, see setMotion
    this.lastChange = -Infinity; // time, milliseconds
    this.pixelDuration = 5e-3; // milliseconds per pixel, a running mean; the initial value is that of a slow machine
    this.sync = null; // fence of the frame that the GPU is drawing
    this.restart();
    if (scene.cameras.length) this.orbit.follow(viewOf(scene.cameras[0]));
    this.orbit.radius = Math.max(this.orbit.radius, 1.3 * scene.orbit.radius);
  }

  get view() {
    const { width, height } = this.tracer.canvas;
    return this.camera === null ? this.orbit.view([width, height]) : viewOf(this.scene.cameras[this.camera]);
  }

  // Trace one ray through the centre of each pixel and show the result immediately.
  drawOnce() {
    const { width, height } = this.tracer.canvas;
    this.tracer.trace(this.view, readSettings(this.scene), [width, height]);
    this.tracer.show({ stride: 1, done: 1 });
  }

  // Restart drawing after a change of view, scene or settings; `budget` limits the duration of drawing, milliseconds.
  changed(budget = Infinity) {
    this.restart();
    this.budget = budget;
    this.onChange?.();
    this.lastChange = performance.now();
    this.requestFrame();
  }

  restart() {
    this.drafted = false; // whether a small image of the view is shown
    this.rays = this.pass = this.row = 0; // complete rays per pixel, complete passes of the next ray, and rows of the next pass
  }

  requestFrame() {
    this.frame ??= requestAnimationFrame((now) => {
      this.frame = null;
      this.step(now);
    });
  }

  // Move the orbit at every frame by `step` of a motion, a function of the seconds since its start that returns whether it
  // goes on. The button of its name is pressed meanwhile. Null stops.
  setMotion(motion) {
    for (const { button } of [this.motion, motion].filter(Boolean)) $(button).setAttribute("aria-pressed", button === motion?.button);
    const hasStopped = this.motion && !motion;
    if (motion && this.camera !== null) this.show(null);
    this.motion = motion && { ...motion, start: performance.now() };
    if (hasStopped) this.changed();
    if (motion) this.onChange?.();
    this.requestFrame();
  }

  move(now) {
    const goesOn = this.motion.step(Math.max(now - this.motion.start, 0) / 1000);
    this.restart();
    if (!goesOn) this.setMotion(null);
  }

  // Draw the next part of the image: first a draft of low resolution, then, when the view does not change, a few rows of a
  // pass at a time, so that the page never waits long for the graphics driver.
  step(now) {
    if (this.isBusy()) return this.requestFrame();
    this.resizeCanvas();
    if (this.motion) this.move(now);
    if (!this.drafted) this.drawDraft();
    else if (now - this.lastChange >= 250) {
      if (this.rays >= this.maxRays || this.budget <= 0) return;
      this.drawRows();
    }
    this.requestFrame();
  }

  isBusy() {
    const { gl } = this.tracer;
    if (!this.sync) return false;
    if (gl.getSyncParameter(this.sync, gl.SYNC_STATUS) !== gl.SIGNALED) return true;
    gl.deleteSync(this.sync);
    this.sync = null;
    const duration = performance.now() - this.frameStart;
    this.budget -= duration;
    // The first draft includes the compilation of the shader.
    if (this.isWarm) {
      // A part of the image may take longer than the previous ones, which must not happen twice.
      const change = duration / this.numPixels - this.pixelDuration;
      this.pixelDuration += (change > 0 ? 0.7 : 0.2) * change;
    }
    this.isWarm = true;
    return false;
  }

  drawDraft() {
    const { width, height } = this.tracer.canvas;
    const scale = clamp(Math.sqrt(MOVING_MS / (this.pixelDuration * width * height)), SCALES.min, SCALES.max);
    const size = [width, height].map((side) => Math.max(1, Math.round(scale * side)));
    this.draw(size, size[0] * size[1], { target: "draft" }, { stride: 1, done: 0 });
    this.drafted = true;
    this.showStatus(size);
  }

  // Trace the next rows of the next pass of the next ray of each pixel. A fast machine traces all pixels in one pass.
  drawRows() {
    const { width, height } = this.tracer.canvas;
    const affordable = STILL_MS / this.pixelDuration;
    if (this.rays + this.pass + this.row === 0) this.stride = affordable >= width * height ? 1 : 4;
    const { stride, pass, rays } = this;
    const [columns, lines] = [width, height].map((side) => Math.ceil(side / stride));
    const numRows = Math.max(1, Math.floor(Math.max(affordable, MIN_PIXELS) / columns));
    const rows = [this.row, Math.min(lines, this.row + numRows)];
    this.row = rows[1] % lines;
    if (this.row === 0) this.pass = (pass + 1) % stride ** 2;
    if (this.row === 0 && this.pass === 0) ++this.rays;
    const options = { stride, pass, rows, jitter: jitter(rays), weight: 1 / (rays + 1) };
    const shown = { stride, done: this.rays > 0 ? stride ** 2 : this.pass };
    this.draw([width, height], columns * (rows[1] - rows[0]), options, this.row === 0 ? shown : null);
    if (this.row === 0) this.showStatus([width, height]);
    const isComplete = this.row === 0 && this.pass === 0;
    if (isComplete && (this.rays & (this.rays - 1)) === 0) this.showPsnr(); // after 1, 2, 4, ... rays per pixel
  }

  // Trace a part of the image, and show the complete parts (`shown`, see Tracer.show), or none.
  draw(size, numPixels, options, shown) {
    const { gl } = this.tracer;
    this.frameStart = performance.now();
    this.numPixels = numPixels;
    this.tracer.trace(this.view, readSettings(this.scene), size, options);
    this.sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    if (shown) this.tracer.show(shown);
    gl.flush();
  }

  // Set the displayed size of the canvas and of the photograph beside it; images of cameras keep their aspect ratio.
  layOut() {
    const stage = $("stage").getBoundingClientRect();
    let [width, height] = [stage.width, stage.height];
    if (this.camera !== null) {
      const [w, h] = this.scene.cameras[this.camera].size;
      const count = $("photograph").hidden || this.isDifference ? 1 : 2;
      const [columns, rows] = stage.width > stage.height ? [count, 1] : [1, count];
      const scale = Math.min(width / (columns * w), height / (rows * h));
      [width, height] = [w * scale, h * scale];
    }
    for (const element of [this.tracer.canvas, $("photograph")]) {
      element.style.width = `${width}px`;
      element.style.height = `${height}px`;
    }
    return [width, height];
  }

  // Give the canvas one pixel per pixel of the screen. This clears the canvas, so a frame must be drawn next.
  resizeCanvas() {
    if (document.body.classList.contains("one-camera")) return;
    const { canvas } = this.tracer;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const size = this.layOut().map((side) => Math.max(1, Math.round(side * ratio)));
    if (canvas.width !== size[0] || canvas.height !== size[1]) {
      [canvas.width, canvas.height] = size;
      this.restart();
    }
  }

  showStatus([width, height]) {
    const rays = this.rays === 1 ? "1 ray" : `${this.rays} rays`;
    const quality = this.rays ? `${rays} per pixel` : this.pass ? `${this.pass} of ${this.stride ** 2} passes` : "draft";
    $("frame").textContent = `${width} x ${height} pixels, ${quality}`;
  }

  // Show the PSNR of the rendering, reduced to the size of the photograph beside it.
  showPsnr() {
    if ($("photograph").hidden || !this.scene.pinhole) return;
    this.tracer.show(); // the browser clears the canvas between frames
    $("rendering").textContent = `rendering, PSNR ${psnr(this.tracer.canvas, $("photograph")).toFixed(1)} dB`;
  }

  // Show the difference between photograph and rendering, or both beside each other.
  setDifference(isDifference) {
    this.isDifference = isDifference;
    $("stage").classList.toggle("difference", isDifference);
    $("difference").setAttribute("aria-pressed", isDifference);
    this.layOut();
    this.changed();
  }

  // Show the view of a camera of the data set beside its photograph, or (null) the orbit, which starts at the present eye.
  show(camera) {
    this.setMotion(null);
    if (camera === null && this.camera !== null) this.orbit.follow(this.view);
    this.camera = camera;
    if (camera === null && this.isDifference) this.setDifference(false);
    const photograph = camera === null ? undefined : this.scene.cameras[camera].photograph;
    $("photograph").hidden = !photograph;
    $("stage").classList.toggle("compared", Boolean(photograph));
    $("difference").disabled = !photograph || !this.scene.pinhole;
    $("rendering").textContent = "rendering";
    if (photograph) $("photograph").src = photograph;
    $("photograph").alt = photograph ? `photograph ${this.scene.cameras[camera].name}` : "";
    for (const button of document.querySelectorAll("#cameras button[value]")) {
      button.setAttribute("aria-pressed", button.value === String(camera ?? ""));
    }
    this.layOut(); // immediately, because the pointer may act on the canvas before the next frame
    this.changed();
  }
}

// Return the offset of a ray from the centre of its pixel: 0 for the first ray, then the Halton sequence.
function jitter(number) {
  const radicalInverse = (n, base) => {
    let [sum, digitValue] = [0, 1];
    for (; n > 0; n = Math.floor(n / base)) sum += (digitValue /= base) * (n % base);
    return sum;
  };
  return number === 0 ? [0, 0] : [radicalInverse(number, 2) - 0.5, radicalInverse(number, 3) - 0.5];
}

// Return the PSNR between two pictures at the size of the second, in dB.
function psnr(picture, reference) {
  const [width, height] = [reference.naturalWidth, reference.naturalHeight];
  const [a, b] = [picture, reference].map((source) => {
    const context = new OffscreenCanvas(width, height).getContext("2d");
    context.imageSmoothingQuality = "high";
    context.drawImage(source, 0, 0, width, height);
    return context.getImageData(0, 0, width, height).data;
  });
  let sum = 0;
  a.forEach((value, i) => (sum += i % 4 < 3 ? (value - b[i]) ** 2 : 0));
  return 10 * Math.log10((3 * width * height * 255 ** 2) / sum);
}

// Return the settings of the controls.
function readSettings(scene) {
  const iors = scene.surface.iors.map((ior, body) => Number($(`ior${body}`)?.value ?? ior));
  // With a strength of 1, the colour (sRGB) is the transmittance along half the width of the object.
  const colour = [1, 3, 5].map((at) => parseInt($("tint-colour").value.slice(at, at + 2), 16) / 255);
  const strength = Number($("tint").value) / scene.orbit.halfWidth;
  const tint = colour.map((c) => -Math.log(Math.max(c, 0.02) ** 2.2) * strength);
  const isAir = (body) => scene.surface.nested && scene.surface.iors[body] === 1;
  const absorption = scene.surface.absorption.map((coefficients, body) =>
    coefficients.map((value, i) => value + (isAir(body) ? 0 : tint[i])));
  return { iors, absorption, straight: Number($("straight")?.value ?? 0), reflection: $("reflection").checked };
}

function initControls(page) {
  const { scene } = page;
  const set = (id, value) => ($(id).value = value);
  const showValue = (id) => ($(`${id}-value`).value = Number($(id).value).toFixed(2));
  scene.surface.iors.forEach((ior, body) => {
    if (!$(`ior${body}`)) return;
    set(`ior${body}`, ior);
    showValue(`ior${body}`);
  });
  showValue("tint");
  if ($("straight")) showValue("straight");
  $("reflection").checked = scene.reflection;
  $("controls").addEventListener("input", (event) => {
    if (event.target.type === "range" && event.target.id !== "time") showValue(event.target.id);
    page.changed();
  });
  $("cameras").addEventListener("click", (event) => {
    const button = event.target.closest("button[value]");
    if (button) page.show(button.value === "" ? null : Number(button.value));
  });
  $("difference").addEventListener("click", () => page.setDifference(!page.isDifference));
  $("reset").addEventListener("click", () => {
    page.show(null);
    page.orbit.reset();
  });
  for (const button of document.querySelectorAll("#cameras button[value]")) {
    const { photograph } = scene.cameras[button.value] ?? {};
    if (photograph) button.prepend(Object.assign(new Image(), { src: photograph, alt: "" }));
  }
}

function initSkyInput(page) {
  const show = (picture) => {
    page.tracer.setPicture(picture);
    $("own-sky").hidden = picture === null;
    page.changed();
  };
  const load = async (file) => {
    try {
      if (file.name.toLowerCase().endsWith(".hdr")) {
        show(decodeHdr(new Uint8Array(await file.arrayBuffer())));
      } else {
        const maxWidth = 4096;
        const image = await createImageBitmap(file);
        const width = Math.min(image.width, maxWidth);
        show(await createImageBitmap(image, { resizeWidth: width, resizeHeight: Math.round((width * image.height) / image.width) }));
      }
      $("message").textContent = "";
    } catch (error) {
      $("message").textContent = `${file.name} cannot be shown as a sky: ${error.message}`;
    }
  };
  $("sky").addEventListener("change", () => $("sky").files.length && load($("sky").files[0]));
  $("own-sky").addEventListener("click", () => {
    $("sky").value = "";
    show(null);
  });
  document.addEventListener("dragover", (event) => event.preventDefault());
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    if (event.dataTransfer.files.length) load(event.dataTransfer.files[0]);
  });
}

function initCanvasInput(page) {
  const { canvas } = page.tracer;
  const pointers = new Map();
  const centroid = () => {
    const all = [...pointers.values()];
    const x = all.reduce((sum, p) => sum + p.x, 0) / all.length;
    const y = all.reduce((sum, p) => sum + p.y, 0) / all.length;
    return { x, y, spread: all.length > 1 ? Math.hypot(all[0].x - all[1].x, all[0].y - all[1].y) : 0 };
  };
  const changeOrbit = (change) => {
    page.setMotion(null);
    if (page.camera !== null) page.show(null);
    change(page.orbit);
    page.changed();
  };
  if (inFrame) canvas.style.touchAction = "pan-y";
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!pointers.has(event.pointerId)) return;
    const before = centroid();
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const after = centroid();
    const side = Math.min(canvas.clientWidth, canvas.clientHeight);
    const [right, up] = [(after.x - before.x) / side, (before.y - after.y) / side];
    changeOrbit((orbit) => {
      if (pointers.size > 1 || event.buttons & 2 || event.shiftKey) orbit.pan(right, up);
      else orbit.turn(4 * right, -4 * up);
      if (before.spread > 0 && after.spread > 0) orbit.zoom(before.spread / after.spread);
    });
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener(
    "wheel",
    (event) => {
      // In a frame, the wheel scrolls the page around it until the image has been clicked.
      if (inFrame && document.activeElement !== canvas) return;
      event.preventDefault();
      changeOrbit((orbit) => orbit.zoom(Math.exp(clamp(event.deltaY, -100, 100) * 0.0015)));
    },
    { passive: false },
  );
  const arrow = (right, up) => (orbit, shift) => (shift ? orbit.pan(-0.05 * right, 0.05 * up) : orbit.turn(0.1 * right, 0.1 * up));
  const keys = {
    ArrowLeft: arrow(1, 0), ArrowRight: arrow(-1, 0), ArrowUp: arrow(0, 1), ArrowDown: arrow(0, -1),
    "+": (orbit) => orbit.zoom(0.9), "=": (orbit) => orbit.zoom(0.9), "-": (orbit) => orbit.zoom(1 / 0.9),
    0: (orbit) => orbit.reset(),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    changeOrbit((orbit) => keys[event.key](orbit, event.shiftKey));
  });
  canvas.addEventListener("webglcontextlost", () => {
    $("message").textContent = "The graphics driver has stopped this page, perhaps because a frame took too long. Reload the page.";
  });
}

// Show only the view of one camera if the address asks for it: `#camera=test_000&size=128` traces one ray per pixel of a
// square of 128 pixels per side. Return whether it does.
function showOneCamera(page) {
  const parameters = new URLSearchParams(location.hash.slice(1));
  const name = parameters.get("camera");
  if (name === null) return false;
  const number = page.scene.cameras.findIndex((camera) => camera.name === name);
  const size = Number(parameters.get("size") ?? 256);
  if (number < 0) throw new Error(`There is no camera ${name}; there are ${page.scene.cameras.map((c) => c.name).join(", ")}.`);
  if (!(Number.isInteger(size) && size >= 1 && size <= 4096)) throw new Error("size must be an integer from 1 to 4096.");
  document.body.classList.add("one-camera");
  const { canvas } = page.tracer;
  canvas.width = canvas.height = size;
  canvas.style.width = canvas.style.height = `${size}px`;
  page.camera = number;
  page.maxRays = 1;
  page.drafted = true;
  // A small picture is complete when the page has loaded.
  if (size <= 256) page.drawOnce();
  else page.requestFrame();
  return true;
}

// Start the page, after a click if it is part of another page, which should not wait for it.
async function start() {
  const scene = JSON.parse($("scene").textContent);
  const alone = new URLSearchParams(location.hash.slice(1)).has("camera");
  if (window.innerWidth <= 700 || inFrame) $("controls").open = false;
  if (inFrame && !alone && !scene.live) await clickOnPoster();
  if (!alone) await nextPaint();
  const images = Object.fromEntries([...document.querySelectorAll("#arrays img")].map((image) => [image.id, image]));
  page = new Page(scene, images);
  initControls(page);
  window.addEventListener("hashchange", () => location.reload());
  if (!showOneCamera(page)) {
    initSkyInput(page);
    initCanvasInput(page);
    initFilm(page);
    initState(page);
    initSaving(page);
    new ResizeObserver(() => page.changed(scene.live ? LIVE_MS : Infinity)).observe($("stage"));
    page.step(performance.now()); // immediately, so that the poster is followed by an image of the scene
  }
  document.body.removeAttribute("data-loading");
  if (scene.live) pollUpdates(page);
}

const inFrame = window.self !== window.top;
const nextPaint = () => new Promise((done) => requestAnimationFrame(() => setTimeout(done)));

function clickOnPoster() {
  $("begin").hidden = false;
  $("loading").hidden = true;
  return new Promise((done) =>
    $("begin").addEventListener("click", () => {
      $("begin").hidden = true;
      $("loading").hidden = false;
      done();
    }));
}

// The images with the arrays are decoded when the page has loaded, so drawing starts then.
let page = null;
window.addEventListener("load", () => {
  start().catch((error) => {
    document.body.removeAttribute("data-loading");
    document.body.classList.add("broken");
    $("message").textContent = error.message;
  });
});
