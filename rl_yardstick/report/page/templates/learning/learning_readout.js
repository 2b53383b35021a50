"use strict";

const made = (name, text, className) => {
  const element = document.createElement(name);
  if (text !== undefined) element.textContent = text;
  if (className) element.className = className;
  return element;
};

// Facts as pairs of a word and a text.
const listOf = (facts) => {
  const list = made("dl");
  for (const [word, text, className] of facts) list.append(made("dt", word), made("dd", text, className));
  return list;
};

const tableOf = (head, rows) => {
  const table = made("table");
  const top = made("tr");
  head.forEach((text) => {
    const cell = made("th", text);
    cell.scope = "col";
    top.append(cell);
  });
  const [thead, tbody] = [made("thead"), made("tbody")];
  thead.append(top);
  for (const [name, ...cells] of rows) {
    const row = made("tr");
    const first = made("th", name);
    first.scope = "row";
    row.append(first, ...cells.map(({ text, className }) => made("td", text, className)));
    tbody.append(row);
  }
  table.append(thead, tbody);
  return table;
};

const ENDS = ["", " (the episode ends)", " (time limit)"];
const signed = (value) => (value > 0 ? `+${shown(value)}` : shown(value));
const sense = (value) => (value === null || value === 0 ? "" : value > 0 ? "td-up" : "td-down");

// The move and the update of a step, in one environment or in each.
const stepFacts = (moves, changes, board) => {
  if (moves.length > 1) {
    const head = ["environment", "state", "action", "reward", "target", "TD error"];
    const rows = moves.map((move) => [
      String(move.env + 1),
      { text: board.name(move.obs) },
      { text: board.action(move.action) },
      { text: shown(move.reward) + ENDS[move.end] },
      { text: shown(move.target) },
      { text: signed(move.td_error), className: sense(move.td_error) },
    ]);
    return tableOf(head, rows);
  }
  const [move] = moves;
  const [only] = changes;
  const facts = [
    ["episode", `${move.episode + 1}, return so far ${shown(move.episode_return)}`],
    ...(move.obs < 0 ? [] : [["state", `${board.name(move.obs)} → ${board.name(move.next_obs)}`]]),
    ["action", board.action(move.action)],
    ["reward", shown(move.reward) + ENDS[move.end]],
    ["target", move.target === null ? "unknown" : shown(move.target, 6)],
    ["TD error", move.td_error === null ? "unknown" : signed(move.td_error), sense(move.td_error)],
  ];
  if (changes.length === 1) facts.push(["entry", `${shown(only.before, 6)} → ${shown(only.after, 6)}`, sense(only.after - only.before)]);
  else facts.push(["entries changed", String(changes.length)]);
  return listOf(facts);
};

// Rows of the tables: those of the step's states, and of the states seen last.
const rowsOf = (data, replay, board, states, changes) => {
  const head = ["", ...data.actions.map((_, action) => board.action(action))];
  const rows = [];
  for (const state of states) {
    for (let copy = 0; copy < replay.copies; copy++) {
      const values = data.actions.map((_, action) => replay.tables[0].values[(copy * data.n_states + state) * data.actions.length + action]);
      const highest = Math.max(...values);
      const name = data.n_states === 1 ? "all" : board.name(state);
      rows.push([
        replay.copies > 1 ? `${name}, table ${copy + 1}` : name,
        ...values.map((value, action) => {
          const moved = changes.find((one) => one.table === 0 && one.state === state && one.action === action && one.after === value);
          const direction = moved === undefined ? "" : moved.after > moved.before ? "up" : "down";
          return { text: shown(value), className: `${direction}${value === highest && values.some((one) => one !== highest) ? " best" : ""}`.trim() };
        }),
      ]);
    }
  }
  return tableOf(head, rows);
};
