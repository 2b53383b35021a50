"use strict";

// A page of maps: one at each evaluation.
const mapShow = (data) => {
  const { moments } = data;
  const { timesteps } = moments;
  // Colours span the optimal values, and as much again below them.
  const [lowest, high] = data.optimal_range;
  const least = moments.values.flat().reduce((a, b) => (b === null ? a : Math.min(a, b)), lowest);
  const low = Math.max(lowest - (high - lowest || 1), least);
  const board = boardOf(data, low, high);
  document.getElementById("board-figure").hidden = !data.is_drawn;
  document.getElementById("board").append(board.svg);
  document.getElementById("legend").textContent = `${data.layout === null ? "Each square is a state; number: the agent's action there" : "Arrows: the agent's action in each cell"}. Colour: the expected return of that policy from there on, computed from the model of the environment (from ${shown(low)}${least < low ? " and below" : ""} to ${shown(high)}). Framed: where the action has changed.`;
  const [begin, end] = [timesteps[0], Math.max(timesteps.at(-1), timesteps[0] + 1)];
  const place = (position) => (timesteps[position] - begin) / (end - begin);
  const curves = [curveOf("Return of the policy, computed", moments.return.map((value, i) => [place(i), value]))].filter((curve) => curve !== null);
  // If prizes belong to the state, a map for each set of collected prizes that episodes can reach.
  const nCells = data.layout === null ? data.n_states : data.n_states / data.layout.layers.length;
  const layers = (data.layout?.layers ?? [[]]).flatMap((cells, layer) => {
    const isReached = moments.values[0].slice(layer * nCells, (layer + 1) * nCells).some((value) => value !== null);
    return isReached ? [{ layer, name: cells.map((cell) => board.name(cell)).join("; ") || "none" }] : [];
  });
  const pick = document.getElementById("layer");
  document.getElementById("layer-pick").hidden = layers.length < 2;
  layers.forEach(({ layer, name }) => {
    const option = made("option", name);
    option.value = layer;
    pick.append(option);
  });
  let shownNow = 0;
  const draw = (position) => {
    shownNow = position;
    const layer = Number(pick.value);
    const [now, before] = [moments.values[position], moments.values[Math.max(position - 1, 0)]];
    const [actions, last] = [moments.actions[position], moments.actions[Math.max(position - 1, 0)]];
    const changed = actions.flatMap((action, state) => (now[state] !== null && action !== last[state] ? [state] : []));
    board.draw(layer, (state) => ({ value: now[state], actions: now[state] === null ? [] : [actions[state]] }));
    board.mark(layer, changed.map((state) => ({ state, action: null, isUp: now[state] >= before[state] })), []);
    board.svg.setAttribute("aria-label", `The agent's policy on the map after ${timesteps[position]} steps`);
    document.getElementById("readout").replaceChildren(listOf([
      ["environment steps", shown(timesteps[position], 12)],
      ["return of the policy, computed", `${shown(moments.return[position])} (optimum ${shown(data.optimum)})`],
      ["changed its action", `in ${changed.length} state${changed.length === 1 ? "" : "s"}${layers.length > 1 ? ", with any prizes" : ""}`],
    ]));
    curves.forEach((curve) => curve.go(place(position)));
    const number = moments.number[position];
    if (number === moments.number[position - 1]) return "at the end";
    return `evaluation ${number.toLocaleString("en")} of ${data.n_units.toLocaleString("en")}`;
  };
  pick.addEventListener("change", () => draw(shownNow));
  return {
    n: timesteps.length - 1,
    draw,
    curves,
    starts: [],
    nextLarge: null,
    speeds: [1, 2, 4, 8, 30],
    speed: 4,
  };
};
