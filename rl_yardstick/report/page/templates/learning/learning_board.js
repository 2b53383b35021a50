"use strict";

const SVG = "http://www.w3.org/2000/svg";
const drawn = (name, attributes, text) => {
  const element = document.createElementNS(SVG, name);
  Object.entries(attributes).forEach(([key, value]) => element.setAttribute(key, value));
  if (text !== undefined) element.textContent = text;
  return element;
};

// The map or, without one, the numbered states in rows. Cells are reused: a draw updates only what
// has changed.
const boardOf = (data, low, high) => {
  const { layout } = data;
  const width = layout === null ? Math.max(Math.min(data.n_states, Math.max(10, Math.ceil(Math.sqrt(data.n_states)))), 1) : layout.rows[0].length;
  const height = layout === null ? Math.ceil(data.n_states / width) : layout.rows.length;
  const nCells = layout === null ? data.n_states : width * height;
  const place = (cell) => [cell % width, Math.floor(cell / width)];
  const svg = drawn("svg", { class: "board", viewBox: `-0.03 -0.03 ${width + 0.06} ${height + 0.06}`, role: "img" });
  svg.style.maxWidth = `${5.5 * width}rem`;
  const ground = drawn("g", {});
  const marks = drawn("g", {});
  svg.append(ground, marks);
  const glyphs = { X: "✕", P: "◆", G: "★" };
  const letterOf = (cell, layer) => {
    if (layout === null) return ".";
    const letter = layout.rows[Math.floor(cell / width)][cell % width];
    return letter === "P" && layout.layers[layer].includes(cell) ? "." : letter;
  };
  const cells = Array.from({ length: nCells }, (_, cell) => {
    const [x, y] = place(cell);
    const group = drawn("g", { transform: `translate(${x} ${y})` });
    const rect = drawn("rect", { class: "cell", width: 1, height: 1 });
    const arrow = drawn("path", { class: "arrow" });
    const letter = drawn("text", { class: "letter", x: 0.5, y: 0.5 });
    group.append(rect);
    if (letterOf(cell, 0) === "S") group.append(drawn("circle", { class: "start", cx: 0.5, cy: 0.5, r: 0.42 }));
    if (layout === null && nCells <= 200) group.append(drawn("text", { class: "number", x: 0.5, y: 0.8 }, cell));
    group.append(arrow, letter);
    ground.append(group);
    return { rect, arrow, letter, fill: "", path: "", word: "" };
  });
  const direction = (action) => {
    const move = layout?.moves[action];
    if (move === undefined || (move[0] === 0 && move[1] === 0)) return null;
    const length = Math.hypot(...move);
    return [move[1] / length, move[0] / length];
  };
  // Across the cell, or from its middle if there are several arrows.
  const arrowTo = (action, _, all) => {
    const to = direction(action);
    if (to === null) return layout === null ? "" : "M0.5 0.5h0.001";
    const [dx, dy] = to;
    const point = (along, aside) => `${(0.5 + along * dx - aside * dy).toFixed(3)} ${(0.5 + along * dy + aside * dx).toFixed(3)}`;
    const [from, tip] = all.length === 1 ? [-0.24, 0.26] : [0.06, 0.4];
    return `M${point(from, 0)}L${point(tip, 0)}M${point(tip - 0.14, 0.12)}L${point(tip, 0)}L${point(tip - 0.14, -0.12)}`;
  };
  const share = (value) => (high > low ? Math.round(100 * Math.min(Math.max((value - low) / (high - low), 0), 1)) : 50);

  // `look(state)` returns the value of a state and its best actions.
  const draw = (layer, look) => {
    cells.forEach((cell, number) => {
      const letter = letterOf(number, layer);
      const state = number + nCells * layer;
      const isEnd = letter === "G" || letter === "X";
      const { value, actions } = letter === "#" || isEnd ? { value: null, actions: [] } : look(state);
      const isNumber = value !== null && Number.isFinite(value);
      const fill = letter === "#" ? "var(--muted)" : !isNumber ? "var(--card)" : `color-mix(in srgb, var(--map-high) ${share(value)}%, var(--map-low))`;
      const path = actions.map(arrowTo).join("");
      const word = glyphs[letter] ?? (value !== null && !isNumber ? shown(value) : layout === null && actions.length === 1 ? String(actions[0]) : "");
      if (cell.fill !== fill) cell.rect.style.fill = cell.fill = fill;
      if (cell.path !== path) cell.arrow.setAttribute("d", (cell.path = path));
      if (cell.word !== word) cell.letter.textContent = cell.word = word;
    });
  };
  const wedge = (action) => {
    const to = direction(action);
    if (to === null || (to[0] !== 0 && to[1] !== 0)) return null;
    const [dx, dy] = to;
    const corner = (side) => `${0.5 + 0.5 * dx - side * 0.5 * dy} ${0.5 + 0.5 * dy + side * 0.5 * dx}`;
    return `M0.5 0.5L${corner(1)}L${corner(-1)}Z`;
  };
  // The entries that a step changed, and the agent's path.
  const mark = (layer, moved, paths) => {
    marks.replaceChildren();
    for (const { state, action, isUp } of moved) {
      if (Math.floor(state / nCells) !== layer || state >= data.n_states) continue;
      const [x, y] = place(state % nCells);
      const group = drawn("g", { transform: `translate(${x} ${y})` });
      const shape = action === null ? null : wedge(action);
      if (shape !== null) group.append(drawn("path", { class: `wedge ${isUp ? "up" : "down"}`, d: shape }));
      group.append(drawn("rect", { class: `moved ${isUp ? "up" : "down"}`, x: 0.04, y: 0.04, width: 0.92, height: 0.92 }));
      marks.append(group);
    }
    for (const { from, to } of paths) {
      const [[x0, y0], [x1, y1]] = [place(from % nCells), place(to % nCells)];
      marks.append(drawn("line", { class: "trace", x1: x0 + 0.5, y1: y0 + 0.5, x2: x1 + 0.5, y2: y1 + 0.5 }));
      marks.append(drawn("circle", { class: "agent", cx: x1 + 0.5, cy: y1 + 0.5, r: 0.2 }));
    }
  };
  const layerOf = (state) => (layout === null ? 0 : Math.floor(state / nCells));
  const name = (state) => {
    if (state < 0) return "–";
    if (layout === null) return `state ${state}`;
    const layer = layerOf(state);
    const collected = layer === 0 ? "" : `, ${layout.layers[layer].length} collected`;
    return `row ${Math.floor((state % nCells) / width) + 1}, column ${(state % width) + 1}${collected}`;
  };
  const action = (number) => {
    const move = layout?.moves[number];
    const words = { "-1,0": "↑ up", "1,0": "↓ down", "0,-1": "← left", "0,1": "→ right" };
    return words[String(move)] ?? data.actions[number] ?? String(number);
  };
  return { svg, draw, mark, layerOf, name, action };
};
