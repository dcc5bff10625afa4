// Live page of a training: asks the server for updates of the model and for the training curve.

const POLL_INTERVAL = 2000; // milliseconds

let hasEnded = false; // whether the server has told the outcome of the training

async function pollUpdates(page) {
  for (;;) {
    // A hidden page sends no requests, so that the training spends no time on updates.
    if (!document.hidden) await fetchUpdate(page);
    await new Promise((done) => setTimeout(done, POLL_INTERVAL));
  }
}

async function fetchUpdate(page) {
  try {
    const answer = await fetch(`state?after=${page.scene.version}`, { cache: "no-store" });
    if (!answer.ok) throw new Error(`${answer.status} ${answer.statusText}`);
    const { losses, update, picture, version, outcome, final } = await answer.json();
    showLosses(losses);
    if (picture) showValidation(picture);
    if (update) await applyUpdate(page, update);
    page.scene.version = version;
    $("message").textContent = "";
    if (outcome) showOutcome(outcome, final, page);
  } catch (error) {
    // After the end, the page remains as it is; `nerfro demo` answers again when the final page is ready.
    if (!hasEnded) $("message").textContent = `nerfro does not answer (${error.message}); it may have ended.`;
  }
}

// Show how the training has ended, and a link to the final page if the server has one; draw the last model completely.
function showOutcome(outcome, final, page) {
  if (!hasEnded) page.changed();
  hasEnded = true;
  // An unchanged text is not set again, because it would be read aloud again.
  if ($("outcome").firstChild?.data !== `${outcome} `) $("outcome").textContent = `${outcome} `;
  if (!final || $("outcome").querySelector("a")) return;
  const link = Object.assign(document.createElement("a"), { href: location.pathname, textContent: "Open the final page" });
  $("outcome").append(link);
}

async function applyUpdate(page, { scene, arrays }) {
  const images = { ...page.images };
  for (const [name, uri] of Object.entries(arrays)) {
    images[name] = new Image();
    images[name].src = uri;
    await images[name].decode();
  }
  updateIndices(page.scene.surface.iors, scene.surface?.iors ?? []);
  page.images = images;
  page.scene = { ...page.scene, ...scene };
  page.tracer.load(page.scene, images);
  page.changed(LIVE_MS);
}

// Set the sliders to the learned refractive indices, except sliders that the user has moved.
function updateIndices(before, after) {
  after.forEach((ior, body) => {
    const slider = $(`ior${body}`);
    if (Number(slider.value) !== before[body]) return;
    slider.value = ior;
    $(`ior${body}-value`).value = ior.toFixed(2);
  });
}

function showValidation({ step, uri }) {
  $("validation").hidden = false;
  $("validation").src = uri;
  $("validation").title = `validation view at step ${step}: rendering, photograph and error`;
}

let shownLosses = []; // the last answer of the server

// Draw the selected curve: PSNR (dB) on a linear scale, losses on a logarithmic one.
function showLosses(losses) {
  shownLosses = losses;
  if (!losses.length) return;
  $("progress").hidden = false;
  const names = new Set(losses.flatMap(([, values]) => Object.keys(values)));
  for (const option of [...$("curve").options]) {
    if (!names.delete(option.value)) option.remove(); // a curve of an earlier training
  }
  for (const name of names) $("curve").add(new Option(name));
  $("curve").onchange = () => showLosses(shownLosses);
  const name = $("curve").value;
  const curve = losses.filter(([, values]) => name in values).map(([step, values]) => [step, values[name]]);
  const [lastStep, last] = curve.at(-1);
  const isPsnr = name.endsWith("psnr");
  const format = (value) => value.toPrecision(3);
  const heights = curve.map(([, value]) => (isPsnr ? value : Math.log(Math.max(value, 1e-9))));
  const [low, high] = [Math.min(...heights), Math.max(...heights)];
  const points = curve.map(([step], i) =>
    `${(1000 * step) / Math.max(lastStep, 1)},${100 - (96 * (heights[i] - low)) / Math.max(high - low, 1e-9) - 2}`);
  document.querySelector("#progress polyline").setAttribute("points", points.join(" "));
  $("losses").textContent = `step ${lastStep}, ${name} ${format(last)}`;
  $("high").textContent = format(isPsnr ? high : Math.exp(high));
  $("low").textContent = format(isPsnr ? low : Math.exp(low));
  $("end").textContent = `step ${lastStep}`;
}
