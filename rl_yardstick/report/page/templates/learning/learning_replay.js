"use strict";

// A number with this many significant digits; "–" for none.
const shown = (value, digits = 4) => {
  if (value === null || value === undefined) return "–";
  if (!Number.isFinite(value)) return Number.isNaN(value) ? "nan" : value > 0 ? "∞" : "−∞";
  if (value !== 0 && (Math.abs(value) < 1e-4 || Math.abs(value) >= 1e7)) return value.toExponential(digits - 1);
  return Number(value.toPrecision(digits)).toLocaleString("en", { maximumFractionDigits: 8 });
};

// Outside of tables, null stands for what is missing; in a table, for a number that is NaN.
const entries = (values) => Float64Array.from(values, (value) => value ?? NaN);

// The tables after any number of steps: going forwards applies changes, going back undoes them.
const replayOf = (data) => {
  const { step, table, entry } = data.changes;
  const after = entries(data.changes.after);
  const tables = data.tables.map(({ name, shape, fill, values }) => {
    const size = shape.reduce((product, n) => product * n, 1);
    return { name, shape, values: values === undefined ? new Float64Array(size).fill(fill ?? NaN) : entries(values) };
  });
  const nSteps = data.steps.timesteps.length;
  const first = new Int32Array(nSteps + 1);
  step.forEach((number) => (first[number + 1] += 1));
  for (let k = 0; k < nSteps; k++) first[k + 1] += first[k];

  // The table that the agent acts on, and the highest and lowest state value at any time.
  const [nStates, nActions] = [data.n_states, data.actions.length];
  const before = new Float64Array(after.length);
  const main = tables[0].values;
  const copies = Math.max(Math.round(main.length / (nStates * nActions)), 1);
  // The agent acts on the mean of its tables.
  const value = (state, action) => {
    let sum = 0;
    for (let t = 0; t < copies; t++) sum += main[(t * nStates + state) * nActions + action];
    return sum / copies;
  };
  const best = (state) => {
    const values = data.actions.map((_, action) => value(state, action));
    const highest = Math.max(...values);
    const actions = values.flatMap((one, action) => (one === highest ? [action] : []));
    return { value: highest, actions: actions.length === nActions ? [] : actions };
  };
  // The range of the finite state values at any time.
  let [low, high] = [Infinity, -Infinity];
  const look = (state) => {
    const { value: highest } = best(state);
    if (!Number.isFinite(highest)) return;
    low = Math.min(low, highest);
    high = Math.max(high, highest);
  };
  for (let state = 0; state < nStates; state++) look(state);
  after.forEach((number, i) => {
    const { values } = tables[table[i]];
    before[i] = values[entry[i]];
    values[entry[i]] = number;
    if (table[i] === 0 && nStates > 0) look(Math.floor(entry[i] / nActions) % nStates);
  });
  for (let i = after.length - 1; i >= 0; i--) tables[table[i]].values[entry[i]] = before[i];

  let at = 0;
  const go = (target) => {
    while (at < target) {
      for (let i = first[at]; i < first[at + 1]; i++) tables[table[i]].values[entry[i]] = after[i];
      at += 1;
    }
    while (at > target) {
      at -= 1;
      for (let i = first[at + 1] - 1; i >= first[at]; i--) tables[table[i]].values[entry[i]] = before[i];
    }
  };
  const changesIn = (number) => {
    if (number < 0) return [];
    const found = [];
    for (let i = first[number]; i < first[number + 1]; i++) {
      const width = tables[table[i]].shape.at(-1);
      const rows = tables[table[i]].shape.at(-2) ?? 1;
      found.push({
        table: table[i],
        state: Math.floor(entry[i] / width) % rows,
        action: entry[i] % width,
        before: before[i],
        after: after[i],
      });
    }
    return found;
  };
  return { tables, go, changesIn, best, copies, low, high, nSteps };
};
