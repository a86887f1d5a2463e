/* Plays the frames of each figure.player. Keys: space, arrows, Home, End. */
for (const figure of document.querySelectorAll("figure.player")) {
  const frames = JSON.parse(figure.querySelector("script[type='application/json']").textContent);
  const labels = JSON.parse(figure.dataset.labels ?? "[]");
  const [image, slider, label] = ["img", "input", "output"].map((name) => figure.querySelector(name));
  const [first, back, play, on] = figure.querySelectorAll("button");
  let [at, timer] = [0, 0];
  const show = (number) => {
    at = (number + frames.length) % frames.length;
    image.src = frames[at];
    slider.value = at;
    slider.setAttribute("aria-valuetext", `${at + 1} of ${frames.length}${labels[at] ? `: ${labels[at]}` : ""}`);
    if (label) label.textContent = labels[at];
  };
  const running = (wanted) => {
    clearInterval(timer);
    timer = wanted ? setInterval(() => show(at + 1), Number(figure.dataset.intervalMs)) : 0;
    play.textContent = wanted ? "Pause" : "Play";
  };
  const step = (number) => { running(false); show(number); };
  const keys = { " ": () => running(!timer), ArrowLeft: () => step(at - 1), ArrowRight: () => step(at + 1),
    Home: () => step(0), End: () => step(frames.length - 1) };
  play.addEventListener("click", () => running(!timer));
  first.addEventListener("click", () => step(0));
  back.addEventListener("click", () => step(at - 1));
  on.addEventListener("click", () => step(at + 1));
  slider.addEventListener("input", () => step(Number(slider.value)));
  figure.addEventListener("keydown", (event) => {
    if (!(event.key in keys) || (event.key === " " && event.target.tagName === "BUTTON")) return;
    keys[event.key]();
    event.preventDefault();
  });
  slider.max = frames.length - 1;
  show(Number(figure.dataset.start ?? 0));
  figure.querySelector(".controls").hidden = false;
  running(!matchMedia("(prefers-reduced-motion: reduce)").matches);
}
