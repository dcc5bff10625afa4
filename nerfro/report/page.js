// Each slider shows the pictures that its selects name, and moves the border between them.
for (const figure of document.querySelectorAll(".slider")) {
  const { view, left, right, border } = figure.querySelector("form").elements;
  const show = () => {
    for (const side of [left, right]) {
      const source = document.getElementById(`${figure.dataset.scene}v${view.value}${side.value}`);
      const picture = figure.querySelector(`svg.${side.name}`);
      picture.querySelector("use").setAttribute("href", `#${source.id}`);
      picture.setAttribute("aria-label", source.dataset.label);
      figure.querySelector(`output.${side.name}`).value = source.dataset.label;
    }
    figure.style.setProperty("--border", `${border.value}%`);
  };
  figure.addEventListener("input", show);
  show();
}
