// Films run where the reader's system does not ask for less motion, and stop when pressed.
report.section("films", (root, films) => {
  const still = matchMedia("(prefers-reduced-motion: reduce)");
  const all = root.querySelector(".all-films");
  const shown = () => [...root.querySelectorAll(".films:not([hidden]) .screen")];

  const play = (screen, isPlaying) => {
    const picture = screen.querySelector("img");
    screen.dataset.still ??= picture.src;
    picture.src = isPlaying ? films[screen.dataset.film] : screen.dataset.still;
    screen.setAttribute("aria-pressed", String(isPlaying));
  };
  const isPlaying = (screen) => screen.getAttribute("aria-pressed") === "true";
  const label = () => {
    const playing = shown().some(isPlaying);
    all.textContent = playing ? "Stop all" : "Play all";
    all.setAttribute("aria-pressed", String(playing));
    all.hidden = shown().length === 0;
  };
  const playAll = (playing) => {
    root.querySelectorAll(".screen").forEach((screen) => play(screen, false));
    shown().forEach((screen) => play(screen, playing));
    label();
  };

  root.querySelectorAll(".screen").forEach((screen) => {
    screen.addEventListener("click", () => {
      play(screen, !isPlaying(screen));
      label();
    });
  });
  all.addEventListener("click", () => playAll(!shown().some(isPlaying)));
  let environment = report.environment;
  report.onChange(() => {
    if (report.environment === environment) return;
    environment = report.environment;
    playAll(!still.matches);
  });
  playAll(!still.matches);
});
