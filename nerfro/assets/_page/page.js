// What is seen: the scene, the view on it, the controls' settings, and when to draw.

const $ = (id) => document.getElementById(id);
const STILL = 64; // rays of a pixel when nothing moves
const MOVING_MS = 30, STILL_MS = 150; // that a frame may take
const SIZES = { smallest: 0.12, largest: 1 }; // share of the canvas's sides that is traced

class Page {
  constructor(scene, images) {
    this.tracer = new Tracer($("canvas"));
    this.scene = scene;
    this.images = images;
    this.tracer.load(scene, images);
    this.orbit = new Orbit(scene.orbit);
    this.camera = null; // number of the data's camera that is shown, null for the orbit
    this.rays = 0; // traced through each pixel since something changed
    this.moved = -Infinity; // time of the last change
    this.milliseconds = 5e-3; // that a pixel takes; a slow machine, until it is known
    this.sync = null; // of the frame that is being drawn
    if (scene.cameras.length) this.orbit.follow(viewOf(scene.cameras[0]));
    this.orbit.radius = Math.max(this.orbit.radius, 1.3 * scene.orbit.radius);
  }

  get view() {
    const { width, height } = this.tracer.canvas;
    return this.camera === null ? this.orbit.view([width, height]) : viewOf(this.scene.cameras[this.camera]);
  }

  // One ray through the centre of each pixel, drawn at once.
  drawOnce() {
    const { width, height } = this.tracer.canvas;
    this.tracer.trace(this.view, settings(this.scene), [width, height]);
    this.tracer.show();
  }

  // Something has changed: draw it in the next frame.
  changed() {
    this.rays = 0;
    this.moved = performance.now();
    this.wake();
  }

  wake() {
    this.frame ??= requestAnimationFrame((now) => {
      this.frame = null;
      this.step(now);
    });
  }

  // Draw the next ray of each pixel, in the resolution that the last frames' time allows.
  step(now) {
    const { gl, canvas } = this.tracer;
    if (this.sync) {
      if (gl.getSyncParameter(this.sync, gl.SYNC_STATUS) !== gl.SIGNALED) return this.wake();
      gl.deleteSync(this.sync);
      this.sync = null;
      const took = (performance.now() - this.begun) / (this.traced[0] * this.traced[1]);
      this.milliseconds += 0.4 * (took - this.milliseconds);
      this.tell(took * this.traced[0] * this.traced[1]);
    }
    this.fit();
    const moving = now - this.moved < 250;
    if (!moving && this.wasMoving) this.rays = 0;
    this.wasMoving = moving;
    if (this.rays >= (moving ? 1 : STILL)) return moving ? this.wake() : undefined;
    const share = Math.sqrt((moving ? MOVING_MS : STILL_MS) / (this.milliseconds * canvas.width * canvas.height));
    const side = clamp(share, SIZES.smallest, SIZES.largest);
    // While rays are added up, the size stays.
    if (this.rays === 0) this.traced = [canvas.width, canvas.height].map((size) => Math.max(1, Math.round(side * size)));
    this.begun = performance.now();
    this.tracer.trace(this.view, settings(this.scene), this.traced, jitter(this.rays), 1 / (this.rays + 1));
    this.tracer.show();
    this.sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.shown = ++this.rays;
    this.wake();
  }

  // Give the canvas, and the photograph beside it, their place; a camera's picture keeps its form.
  layOut() {
    const stage = $("stage").getBoundingClientRect();
    let [width, height] = [stage.width, stage.height];
    if (this.camera !== null) {
      const [w, h] = this.scene.cameras[this.camera].size;
      const beside = $("photograph").hidden ? 1 : 2;
      const scale = Math.min(width / (stage.width > stage.height ? beside * w : w), height / (stage.width > stage.height ? h : beside * h));
      [width, height] = [w * scale, h * scale];
    }
    for (const part of [this.tracer.canvas, $("photograph")]) {
      part.style.width = `${width}px`;
      part.style.height = `${height}px`;
    }
    return [width, height];
  }

  // Give the canvas as many pixels as it is shown with. This clears it, so a frame is drawn next.
  fit() {
    const { canvas } = this.tracer;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const size = this.layOut().map((side) => Math.max(1, Math.round(side * ratio)));
    if (canvas.width !== size[0] || canvas.height !== size[1]) {
      [canvas.width, canvas.height] = size;
      this.rays = 0;
    }
  }

  tell(milliseconds) {
    const [width, height] = this.traced;
    const rays = this.shown === 1 ? "1 ray" : `${this.shown} rays`;
    $("frame").value = `${width} x ${height}, ${milliseconds.toFixed(0)} ms, ${rays} a pixel`;
  }

  // Show the picture of one of the data's cameras beside its photograph, or the orbit (null) from where the eye is.
  show(camera) {
    if (camera === null && this.camera !== null) this.orbit.follow(this.view);
    this.camera = camera;
    const photograph = camera === null ? undefined : this.scene.cameras[camera].photograph;
    $("photograph").hidden = !photograph;
    if (photograph) $("photograph").src = photograph;
    $("photograph").alt = photograph ? `photograph ${this.scene.cameras[camera].name}` : "";
    for (const button of document.querySelectorAll("#cameras button")) {
      button.setAttribute("aria-pressed", button.value === String(camera ?? ""));
    }
    this.layOut(); // now, so that a pointer finds the canvas before the next frame is drawn
    this.changed();
  }
}

// Places in a pixel, relative to its centre, that cover it evenly; the centre first (Halton's sequence).
function jitter(number) {
  const digits = (n, base) => {
    let [place, share] = [0, 1];
    for (; n > 0; n = Math.floor(n / base)) place += (share /= base) * (n % base);
    return place;
  };
  return number === 0 ? [0, 0] : [digits(number, 2) - 0.5, digits(number, 3) - 0.5];
}

// What the controls say.
function settings(scene) {
  const iors = scene.surface.iors.map((own, body) => Number($(`ior${body}`)?.value ?? own));
  // The share of sRGB light that is left of each channel after half the object's width.
  const colour = [1, 3, 5].map((at) => parseInt($("tint-colour").value.slice(at, at + 2), 16) / 255);
  const strength = Number($("tint").value) / scene.orbit.halfWidth;
  const tint = colour.map((c) => -Math.log(Math.max(c, 0.02) ** 2.2) * strength);
  const isAir = (body) => scene.surface.nested && scene.surface.iors[body] === 1;
  const absorption = scene.surface.absorption.map((own, body) =>
    own.map((value, i) => value + (isAir(body) ? 0 : tint[i])));
  return { iors, absorption, glass: $("glass").checked, reflection: $("reflection").checked };
}

function fillControls(page) {
  const { scene } = page;
  const set = (id, value) => ($(id).value = value);
  const say = (id) => ($(`${id}-value`).value = Number($(id).value).toFixed(2));
  scene.surface.iors.forEach((ior, body) => {
    if (!$(`ior${body}`)) return;
    set(`ior${body}`, ior);
    say(`ior${body}`);
  });
  say("tint");
  $("reflection").checked = scene.reflection;
  $("controls").addEventListener("input", (event) => {
    if (event.target.type === "range") say(event.target.id);
    page.changed();
  });
  $("cameras").addEventListener("click", (event) => {
    if (event.target.matches("button")) page.show(event.target.value === "" ? null : Number(event.target.value));
  });
  $("reset").addEventListener("click", () => {
    page.orbit.reset();
    page.show(null);
  });
}

function fillSky(page) {
  const show = (picture) => {
    page.tracer.setPicture(picture);
    $("own-sky").hidden = picture === null;
    page.changed();
  };
  const take = async (file) => {
    try {
      if (file.name.toLowerCase().endsWith(".hdr")) {
        show(decodeHdr(new Uint8Array(await file.arrayBuffer())));
      } else {
        const largest = 4096;
        const image = await createImageBitmap(file);
        const width = Math.min(image.width, largest);
        show(await createImageBitmap(image, { resizeWidth: width, resizeHeight: Math.round((width * image.height) / image.width) }));
      }
      $("message").textContent = "";
    } catch (error) {
      $("message").textContent = `${file.name} cannot be shown as a sky: ${error.message}`;
    }
  };
  $("sky").addEventListener("change", () => $("sky").files.length && take($("sky").files[0]));
  $("own-sky").addEventListener("click", () => {
    $("sky").value = "";
    show(null);
  });
  document.addEventListener("dragover", (event) => event.preventDefault());
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    if (event.dataTransfer.files.length) take(event.dataTransfer.files[0]);
  });
}

function fillCanvas(page) {
  const { canvas } = page.tracer;
  const pointers = new Map();
  const middle = () => {
    const all = [...pointers.values()];
    const x = all.reduce((sum, p) => sum + p.x, 0) / all.length;
    const y = all.reduce((sum, p) => sum + p.y, 0) / all.length;
    return { x, y, spread: all.length > 1 ? Math.hypot(all[0].x - all[1].x, all[0].y - all[1].y) : 0 };
  };
  const act = (change) => {
    if (page.camera !== null) page.show(null);
    change(page.orbit);
    page.changed();
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!pointers.has(event.pointerId)) return;
    const before = middle();
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const after = middle();
    const side = Math.min(canvas.clientWidth, canvas.clientHeight);
    const [right, up] = [(after.x - before.x) / side, (before.y - after.y) / side];
    act((orbit) => {
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
      event.preventDefault();
      act((orbit) => orbit.zoom(Math.exp(clamp(event.deltaY, -100, 100) * 0.0015)));
    },
    { passive: false },
  );
  const keys = {
    ArrowLeft: (orbit) => orbit.turn(0.1, 0), ArrowRight: (orbit) => orbit.turn(-0.1, 0),
    ArrowUp: (orbit) => orbit.turn(0, 0.1), ArrowDown: (orbit) => orbit.turn(0, -0.1),
    "+": (orbit) => orbit.zoom(0.9), "=": (orbit) => orbit.zoom(0.9), "-": (orbit) => orbit.zoom(1 / 0.9),
    0: (orbit) => orbit.reset(),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act(keys[event.key]);
  });
  canvas.addEventListener("webglcontextlost", () => {
    $("message").textContent = "The graphics driver has stopped this page (a frame took too long?). Reload it.";
  });
}

// `#camera=test_000&size=128` shows that camera's picture alone, one ray a pixel, in a square of so many pixels.
function alone(page) {
  const wanted = new URLSearchParams(location.hash.slice(1));
  const name = wanted.get("camera");
  if (name === null) return false;
  const number = page.scene.cameras.findIndex((camera) => camera.name === name);
  const size = Number(wanted.get("size") ?? 256);
  if (number < 0) throw new Error(`There is no camera ${name}; there are ${page.scene.cameras.map((c) => c.name).join(", ")}.`);
  if (!(Number.isInteger(size) && size >= 1 && size <= 4096)) throw new Error("size needs a whole number from 1 to 4096.");
  document.body.classList.add("alone");
  const { canvas } = page.tracer;
  canvas.width = canvas.height = size;
  canvas.style.width = canvas.style.height = `${size}px`;
  page.camera = number;
  page.drawOnce();
  return true;
}

function start() {
  const scene = JSON.parse($("scene").textContent);
  const images = Object.fromEntries([...document.querySelectorAll("#arrays img")].map((image) => [image.id, image]));
  const page = new Page(scene, images);
  fillControls(page);
  window.addEventListener("hashchange", () => location.reload());
  if (!alone(page)) {
    fillSky(page);
    fillCanvas(page);
    if (window.innerWidth <= 700) $("controls").open = false;
    new ResizeObserver(() => page.changed()).observe($("stage"));
    page.changed();
    page.step(performance.now()); // now, so that the page never shows an empty canvas
  }
  return page;
}

// Pictures are decoded when the page has loaded, so that it is drawn with its first frame.
let page = null;
window.addEventListener("load", () => {
  try {
    page = start();
    if (page.scene.live) watch(page);
  } catch (error) {
    document.body.classList.add("broken");
    $("message").textContent = error.message;
  }
});
