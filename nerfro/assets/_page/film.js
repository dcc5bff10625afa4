// Key views on a time line, which are played and saved for `nerfro.render path=FILE`, and the turntable.

const KEY_SECONDS = 2; // between two key views
const FRAME_RATE = 24; // frames per second of a saved film
const TURN_SECONDS = 20; // of one revolution of the turntable
const LOGARITHMIC = [2, 6]; // numbers of Orbit.numbers that are positive: radius and field of view

class Film {
  constructor(page) {
    this.page = page;
    this.keys = []; // numbers of the orbit of each key view
  }

  get seconds() {
    return KEY_SECONDS * Math.max(this.keys.length - 1, 0);
  }

  // Return the numbers of the orbit at a time: Catmull-Rom splines through those of the key views.
  at(time) {
    const last = this.keys.length - 1;
    const first = clamp(Math.floor(time / KEY_SECONDS), 0, Math.max(last - 1, 0));
    const t = time / KEY_SECONDS - first;
    const scaled = (numbers, f) => numbers.map((x, i) => (LOGARITHMIC.includes(i) ? f(x) : x));
    const [a, b, c, d] = [-1, 0, 1, 2].map((step) => scaled(this.keys[clamp(first + step, 0, last)], Math.log));
    const numbers = b.map((x, i) =>
      x + 0.5 * t * (c[i] - a[i] + t * (2 * a[i] - 5 * x + 4 * c[i] - d[i] + t * (3 * (x - c[i]) + d[i] - a[i]))));
    numbers[1] = clamp(numbers[1], -MAX_ELEVATION, MAX_ELEVATION);
    return scaled(numbers, Math.exp);
  }

  // Add the present view at the end; the camera takes the shorter way around the object.
  add() {
    if (this.page.camera !== null) this.page.show(null);
    const numbers = this.page.orbit.numbers();
    const turns = this.keys.length ? Math.round((numbers[0] - this.keys.at(-1)[0]) / (2 * Math.PI)) : 0;
    numbers[0] -= 2 * Math.PI * turns;
    this.setKeys([...this.keys, numbers]);
    $("time").value = this.seconds;
    this.showTime();
  }

  setKeys(keys) {
    this.keys = keys;
    const button = (_, i) => Object.assign(document.createElement("button"), { type: "button", textContent: i + 1, value: i, ariaLabel: `key view ${i + 1}` });
    $("keys").replaceChildren(...keys.map(button));
    $("time").max = this.seconds || 1;
    for (const id of ["time", "play", "save-film"]) $(id).disabled = keys.length < 2;
    $("remove-key").disabled = !keys.length;
    this.showTime();
    this.page.onChange?.();
  }

  // Show the view at a time of the film.
  seek(time) {
    $("time").value = time;
    this.showTime();
    if (this.page.camera !== null) this.page.show(null);
    this.page.orbit.setNumbers(this.at(time));
  }

  showTime() {
    $("time-value").value = `${Number($("time").value).toFixed(1)} s`;
  }

  // Return the motion of Page.setMotion that plays the film from the time of the slider, or from the beginning.
  playback() {
    const begin = Number($("time").value) < this.seconds - 0.01 ? Number($("time").value) : 0;
    return {
      button: "play",
      step: (elapsed) => {
        this.seek(Math.min(begin + elapsed, this.seconds));
        return begin + elapsed < this.seconds;
      },
    };
  }

  // Return the views of all frames, of the size of the canvas.
  views() {
    const { canvas } = this.page.tracer;
    const orbit = new Orbit(this.page.scene.orbit);
    return Array.from({ length: FRAME_RATE * this.seconds + 1 }, (_, frame) => {
      orbit.setNumbers(this.at(frame / FRAME_RATE));
      return orbit.view([canvas.width, canvas.height]);
    });
  }
}

// Return the motion of Page.setMotion that circles the object.
function turntable(page) {
  let before = 0;
  return {
    button: "turn",
    step: (elapsed) => {
      page.orbit.turn((-2 * Math.PI * (elapsed - before)) / TURN_SECONDS, 0);
      before = elapsed;
      return true;
    },
  };
}

function initFilm(page) {
  const film = (page.film = new Film(page));
  const toggle = (button, motion) =>
    $(button).addEventListener("click", () => page.setMotion(page.motion?.button === button ? null : motion()));
  toggle("turn", () => turntable(page));
  toggle("play", () => film.playback());
  $("add-key").addEventListener("click", () => film.add());
  $("remove-key").addEventListener("click", () => film.setKeys(film.keys.slice(0, -1)));
  $("keys").addEventListener("click", (event) => {
    if (!event.target.matches("button")) return;
    page.setMotion(null);
    film.seek(KEY_SECONDS * Number(event.target.value));
    page.changed();
  });
  $("time").addEventListener("input", () => {
    page.setMotion(null);
    film.seek(Number($("time").value));
  });
  film.setKeys([]);
}
