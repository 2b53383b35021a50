"use strict";

const start = (data) => {
  const show = data.kind === "steps" ? stepShow(data) : mapShow(data);
  const find = (name) => document.getElementById(name);
  const [slider, play, speed] = [find("position"), find("play"), find("speed")];
  find("player").hidden = false;
  show.curves.forEach((curve) => find("curves").append(...curve.elements));
  find("curves").hidden = show.curves.length === 0;
  slider.max = show.n;
  slider.value = 0;
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  show.speeds.forEach((each) => {
    const option = made("option", `${each} a second`);
    option.value = each;
    option.selected = each === (still ? show.speeds[0] : show.speed);
    speed.append(option);
  });

  let position = 0;
  let timer = null;
  const go = (target) => {
    position = Math.min(Math.max(target, 0), show.n);
    slider.value = position;
    const words = show.draw(position);
    find("moment").textContent = words;
    slider.setAttribute("aria-valuetext", words);
  };
  const pause = () => {
    clearInterval(timer);
    timer = null;
    play.textContent = "Play";
    play.setAttribute("aria-pressed", "false");
    find("readout").setAttribute("aria-live", "polite");
  };
  const run = () => {
    clearInterval(timer);
    // Above 30 steps a second, several steps at once.
    const each = Math.max(Math.round(Number(speed.value) / 30), 1);
    timer = setInterval(() => {
      go(position + each);
      if (position >= show.n) pause();
    }, (1000 * each) / Number(speed.value));
  };
  const toggle = () => {
    if (timer !== null) {
      pause();
      return;
    }
    if (position >= show.n) go(0);
    play.textContent = "Pause";
    play.setAttribute("aria-pressed", "true");
    find("readout").setAttribute("aria-live", "off"); // nobody could read it aloud as fast
    run();
  };
  const jump = (target) => {
    pause();
    go(target);
  };
  const nextEpisode = () => jump((show.starts.find((begin) => begin > position - 1) ?? show.n - 1) + 1);
  const thisEpisode = () => jump((show.starts.findLast((begin) => begin < position - 1) ?? -1) + 1);
  const nextLarge = () => jump(show.nextLarge(position));

  play.addEventListener("click", toggle);
  find("back").addEventListener("click", () => jump(position - 1));
  find("forward").addEventListener("click", () => jump(position + 1));
  slider.addEventListener("input", () => jump(Number(slider.value)));
  speed.addEventListener("change", () => {
    if (timer !== null) run();
  });
  const offered = [];
  if (show.starts.length > 0) {
    find("back-episode").hidden = find("next-episode").hidden = false;
    find("back-episode").addEventListener("click", thisEpisode);
    find("next-episode").addEventListener("click", nextEpisode);
    offered.push("n and p to the next episode and back");
  }
  if (show.nextLarge !== null) {
    find("next-large").hidden = false;
    find("next-large").textContent = show.largeWord;
    find("next-large").addEventListener("click", nextLarge);
    offered.push(`e to the ${show.largeWord.toLowerCase()}, of the largest twentieth`);
  }
  find("more-keys").textContent = offered.map((text) => `, ${text}`).join("");

  const faster = (by) => {
    speed.selectedIndex = Math.min(Math.max(speed.selectedIndex + by, 0), speed.options.length - 1);
    if (timer !== null) run();
  };
  const keys = {
    " ": toggle,
    ArrowLeft: (event) => jump(position - (event.shiftKey ? 10 : 1)),
    ArrowRight: (event) => jump(position + (event.shiftKey ? 10 : 1)),
    Home: () => jump(0),
    End: () => jump(show.n),
    "+": () => faster(1),
    "-": () => faster(-1),
    ...(show.starts.length > 0 ? { n: nextEpisode, p: thisEpisode } : {}),
    ...(show.nextLarge !== null ? { e: nextLarge } : {}),
  };
  document.addEventListener("keydown", (event) => {
    const action = keys[event.key];
    if (action === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    // A list has keys of its own, and the space bar presses a button that has the focus.
    if (event.target.closest("select") !== null || (event.key === " " && event.target.closest("button") !== null)) return;
    event.preventDefault();
    action(event);
  });

  const button = find("theme");
  const name = () => (button.textContent = `Theme: ${theme.choice}`);
  theme.onChange(name);
  button.addEventListener("click", () => theme.next());
  name();
  go(0);
};

// JSON has no infinite numbers, but a table that diverges has.
const INFINITE = new Map([["Infinity", Infinity], ["-Infinity", -Infinity]]);
const read = (text) => (text.includes('Infinity"') ? JSON.parse(text, (_, value) => INFINITE.get(value) ?? value) : JSON.parse(text));

(async () => {
  try {
    const letters = atob(document.getElementById("data").textContent);
    const bytes = new Uint8Array(letters.length);
    for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    start(read(await new Response(stream).text()));
  } catch (error) {
    document.getElementById("too-old").hidden = false;
    throw error;
  }
})();
