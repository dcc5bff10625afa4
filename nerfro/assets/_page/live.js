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
    const { losses, update, outcome, final } = await answer.json();
    showLosses(losses);
    if (update) await applyUpdate(page, update);
    $("message").textContent = "";
    if (outcome) showOutcome(outcome, final);
  } catch (error) {
    // After the end, the page remains as it is; `nerfro demo` answers again when the final page is ready.
    if (!hasEnded) $("message").textContent = `nerfro does not answer (${error.message}); it may have ended.`;
  }
}

// Show how the training has ended, and a link to the final page if the server has one.
function showOutcome(outcome, final) {
  hasEnded = true;
  $("outcome").textContent = `${outcome} `;
  if (!final) return;
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
  page.changed();
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

function showLosses(losses) {
  const last = losses.at(-1);
  if (!last) return;
  $("progress").hidden = false;
  $("losses").textContent = `step ${last[0]}, training loss ${last[1].toPrecision(3)}`;
  const logs = losses.map(([, loss]) => Math.log(Math.max(loss, 1e-9)));
  const [low, high] = [Math.min(...logs), Math.max(...logs)];
  const points = losses.map(([step], i) =>
    `${(1000 * step) / Math.max(last[0], 1)},${100 - (96 * (logs[i] - low)) / Math.max(high - low, 1e-9) - 2}`);
  document.querySelector("#progress polyline").setAttribute("points", points.join(" "));
}
