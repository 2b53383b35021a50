"use strict";

// What a page of steps shows: `n` positions, of which 0 is before the first step.
const stepShow = (data) => {
  const replay = replayOf(data);
  const board = boardOf(data, replay.low, replay.high);
  const { moves, steps } = data;
  const n = replay.nSteps;
  const nEnvs = n === 0 ? 1 : moves.step.length / n;
  const names = Object.keys(moves);
  const movesIn = (number) =>
    number < 0 ? [] : Array.from({ length: nEnvs }, (_, i) => Object.fromEntries(names.map((name) => [name, moves[name][number * nEnvs + i]])));
  // Where an episode begins, and where much is learnt: the largest twentieth.
  const starts = [];
  const sizes = new Float64Array(n);
  const tells = moves.td_error.some((error) => error !== null);
  for (let k = 0; k < n; k++) {
    for (const move of movesIn(k)) {
      if (k > 0 && moves.end[(k - 1) * nEnvs + move.env] > 0 && starts.at(-1) !== k) starts.push(k);
      if (tells) sizes[k] = Math.max(sizes[k], Math.abs(move.td_error ?? 0));
    }
    if (!tells) for (const { before, after } of replay.changesIn(k)) sizes[k] = Math.max(sizes[k], Math.abs(after - before));
  }
  const sorted = sizes.slice().sort();
  const large = Math.max(sorted[Math.floor(0.95 * n)] ?? 0, Number.MIN_VALUE);
  const nextLarge = (position) => {
    for (let k = position; k < n; k++) if (sizes[k] >= large) return k + 1;
    return position;
  };

  const figure = document.getElementById("board-figure");
  figure.hidden = !data.is_drawn;
  if (data.is_drawn) document.getElementById("board").append(board.svg);
  const scale = `from ${shown(replay.low)} to ${shown(replay.high)}`;
  document.getElementById("legend").textContent = data.layout === null
    ? `Each square is a state; colour and number: value and number of the action that the table holds for the best (${scale}). Framed: what has just moved.`
    : `Colour: the highest value that the table holds for a cell (${scale}). Arrows: the actions of that value. Framed: what has just moved, up in green, down in orange.`;

  const returns = [];
  moves.end.forEach((end, i) => {
    if (end > 0) returns.push([(moves.step[i] + 1) / n, moves.episode_return[i]]);
  });
  const along = (values) => values.map((value, k) => [(k + 1) / n, value]);
  const rates = steps.exploration.some((rate) => rate !== 0) ? curveOf("Exploration", along(steps.exploration)) : null;
  const curves = [curveOf("Return of each episode", returns), rates].filter((curve) => curve !== null);

  const readout = document.getElementById("readout");
  const rows = document.getElementById("rows");
  rows.hidden = data.n_states === 0;
  const seenLately = (number) => {
    const seen = [];
    for (let i = (number + 1) * nEnvs - 1; i >= 0 && seen.length < 8; i--) {
      if (!seen.includes(moves.obs[i])) seen.push(moves.obs[i]);
    }
    return seen;
  };
  const draw = (position) => {
    replay.go(position);
    const number = position - 1;
    const done = movesIn(number);
    const changes = replay.changesIn(number);
    if (data.is_drawn) {
      const layer = board.layerOf(done[0]?.next_obs ?? moves.obs[0] ?? 0);
      board.draw(layer, replay.best);
      const moved = changes.filter(({ table }) => table === 0).map((one) => ({ ...one, isUp: one.after > one.before }));
      const paths = done.filter(({ next_obs }) => board.layerOf(next_obs) === layer).map(({ obs, next_obs }) => ({ from: obs, to: next_obs }));
      if (number < 0 && n > 0) paths.push({ from: moves.obs[0], to: moves.obs[0] });
      board.mark(layer, moved, paths);
      const where = done.map((move) => board.name(move.next_obs)).join("; ");
      board.svg.setAttribute("aria-label", `Values of the table on the map; agent at ${where || board.name(moves.obs[0] ?? 0)}`);
    }
    readout.replaceChildren(number < 0 ? made("p", "Before the first step.") : stepFacts(done, changes, board));
    if (data.n_states > 0) {
      const single = data.n_states === 1;
      const near = [...new Set(done.flatMap(({ obs, next_obs }) => [obs, next_obs]))].filter((state) => state >= 0);
      const states = single ? [0] : data.layout === null ? [...new Set([...near, ...seenLately(number)])] : near;
      rows.replaceChildren(rowsOf(data, replay, board, states.slice(0, 8), changes));
    }
    const rate = number < 0 ? null : steps.learning_rate[number];
    const words = number < 0 ? "" : `, ${shown(steps.timesteps[number], 12)} in all${rate === null ? "" : `, step size ${shown(rate)}`}`;
    curves.forEach((curve) => curve.go(n === 0 ? 0 : position / n));
    return `step ${position} of ${n}${nEnvs > 1 ? words : rate === null || number < 0 ? "" : `, step size ${shown(rate)}`}`;
  };
  const episodes = moves.end.filter((end) => end > 0).length;
  return {
    n,
    draw,
    curves,
    starts,
    nextLarge: n > 0 && large > Number.MIN_VALUE ? nextLarge : null,
    largeWord: tells ? "Next large error" : "Next large change",
    extent: `${n.toLocaleString("en")} steps, ${episodes.toLocaleString("en")} whole episode${episodes === 1 ? "" : "s"}`,
    speeds: [1, 4, 15, 60, 250, 1000],
    speed: 4,
  };
};

// What a page of maps shows: one at each evaluation.
const mapShow = (data) => {
  const { moments } = data;
  const values = moments.flatMap((moment) => moment.values).filter((value) => value !== null);
  const [low, high] = [values.reduce((a, b) => Math.min(a, b), Infinity), values.reduce((a, b) => Math.max(a, b), -Infinity)];
  const board = boardOf(data, low, high);
  document.getElementById("board-figure").hidden = !data.is_drawn;
  document.getElementById("board").append(board.svg);
  document.getElementById("legend").textContent = `${data.layout === null ? "Numbers: the action that the agent takes in each state, a square" : "Arrows: what the agent does in each cell"}. Colour: the expected return of that policy from there on, computed from the model of the environment (from ${shown(low)} to ${shown(high)}). Framed: where it does something else than before.`;
  const last = Math.max(moments.at(-1).timesteps, 1);
  const curves = [
    curveOf("Return of the policy, computed", moments.map((moment) => [moment.timesteps / last, moment.return])),
    moments.some((moment) => moment.exploration !== null) ? curveOf("Exploration", moments.map((moment) => [moment.timesteps / last, moment.exploration])) : null,
  ].filter((curve) => curve !== null);
  const nLayers = data.layout === null ? 1 : data.layout.layers.length;
  const draw = (position) => {
    const moment = moments[position];
    const before = moments[Math.max(position - 1, 0)];
    const changed = moment.actions.flatMap((action, state) => (moment.values[state] !== null && action !== before.actions[state] ? [state] : []));
    board.draw(0, (state) => ({ value: moment.values[state], actions: moment.values[state] === null ? [] : [moment.actions[state]] }));
    board.mark(0, changed.map((state) => ({ state, action: null, isUp: moment.values[state] >= before.values[state] })), []);
    board.svg.setAttribute("aria-label", `The agent's policy on the map after ${moment.timesteps} steps`);
    document.getElementById("readout").replaceChildren(listOf([
      ["environment steps", shown(moment.timesteps, 12)],
      ["return of the policy", `${shown(moment.return)} (optimum ${shown(data.optimum)})`],
      ["exploration", moment.exploration === null ? "by its own probabilities" : shown(moment.exploration)],
      ["does something else", `in ${changed.length} state${changed.length === 1 ? "" : "s"}${nLayers > 1 ? ", of all sets of prizes" : ""}`],
    ]));
    curves.forEach((curve) => curve.go(moment.timesteps / last));
    return `evaluation ${position + 1} of ${moments.length}`;
  };
  return {
    n: moments.length - 1,
    draw,
    curves,
    starts: [],
    nextLarge: null,
    extent: `${moments.length} moments`,
    speeds: [1, 2, 4, 8],
    speed: 2,
  };
};

const start = (data) => {
  const show = data.kind === "steps" ? stepShow(data) : mapShow(data);
  const find = (name) => document.getElementById(name);
  const [slider, play, speed] = [find("position"), find("play"), find("speed")];
  find("extent").textContent = show.extent;
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
    // Beyond what a screen draws, several steps at once.
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
    // A list goes by its own keys, and so does a button that is pressed by the space bar.
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

(async () => {
  try {
    const letters = atob(document.getElementById("data").textContent);
    const bytes = new Uint8Array(letters.length);
    for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    start(JSON.parse(await new Response(stream).text()));
  } catch (error) {
    document.getElementById("too-old").hidden = false;
    throw error;
  }
})();
