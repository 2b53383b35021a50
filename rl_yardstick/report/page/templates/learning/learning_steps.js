"use strict";

// A page of steps: positions 0 to `n`, where 0 is before the first step.
const stepShow = (data) => {
  const replay = replayOf(data);
  const board = boardOf(data, replay.low, replay.high);
  const { moves, steps } = data;
  const n = replay.nSteps;
  const nEnvs = n === 0 ? 1 : moves.step.length / n;
  const names = Object.keys(moves);
  const movesIn = (number) =>
    number < 0 ? [] : Array.from({ length: nEnvs }, (_, i) => Object.fromEntries(names.map((name) => [name, moves[name][number * nEnvs + i]])));
  // Where episodes begin, and where learning is largest: the top twentieth of steps.
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
  // NaN counts as larger than any number.
  for (let k = 0; k < n; k++) if (Number.isNaN(sizes[k])) sizes[k] = Infinity;
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
    ? `Each square is a state; colour and number: value and number of the table's greedy action (${scale}). Framed: what has just changed.`
    : `Colour: the highest value in the table for a cell (${scale}). Arrows: the actions of that value. Framed: what has just changed, up in green, down in orange.`;

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
  return {
    n,
    draw,
    curves,
    starts,
    nextLarge: n > 0 && large > Number.MIN_VALUE ? nextLarge : null,
    largeWord: tells ? "Next large error" : "Next large change",
    speeds: [1, 4, 15, 60, 250, 1000],
    speed: 4,
  };
};
