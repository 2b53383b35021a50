// Maps of grid worlds: what agents do on each cell, at one moment of their training.
report.section("policies", (root, _, chosen) => {
  const SVG = "http://www.w3.org/2000/svg";
  const [boards, readout, output] = [".boards", ".cell", "output"].map((query) => root.querySelector(query));
  const [seed, layer] = [".seed", ".layer"].map((query) => root.querySelector(query));
  const slider = root.querySelector("#progress");
  const play = root.querySelector(".play");
  const still = readout.textContent;
  let maps = []; // what is drawn: a title, and functions of the state
  let moments = []; // steps that the slider stops at
  let timer = null;

  const moment = () => moments[Number(slider.value)];
  const runs = () => chosen().runs.filter((run) => run.seed === Number(seed.lastElementChild.value));
  const nCells = () => chosen().rows.length * chosen().rows[0].length;
  const firstState = () => Number(layer.lastElementChild.value) * nCells();

  const element = (name, attributes, ...children) => {
    const made = document.createElementNS(SVG, name);
    Object.entries(attributes).forEach(([key, value]) => made.setAttribute(key, value));
    made.append(...children);
    return made;
  };
  const fill = (label, options) => {
    label.hidden = options.length < 2;
    label.lastElementChild.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
  };
  const place = (cell) => {
    const width = chosen().rows[0].length;
    return `row ${Math.floor(cell / width) + 1}, column ${(cell % width) + 1}`;
  };
  const word = ([down, right]) =>
    [["up", "", "down"][down + 1], ["left", "", "right"][right + 1]].filter(Boolean).join(" and ") || "stay";

  // The last map of a run that is not later than the slider.
  const current = (run) => {
    const later = run.steps.findIndex((step) => step > moment());
    return Math.max(later < 0 ? run.steps.length - 1 : later - 1, 0);
  };
  const bestActions = (state) =>
    chosen().moves.map((_, action) => action).filter((action) => (chosen().optimum.actions[state] >> action) & 1);

  const makeMaps = () => [
    {
      title: "optimum",
      value: (state) => chosen().optimum.values[state],
      actions: bestActions,
    },
    ...runs().map((run) => ({
      title: run.agent,
      mark: report.mark(run.agent),
      value: (state) => run.values[current(run)][state],
      actions: (state) => [Number(run.actions[current(run)][state])],
    })),
  ];

  // Colours span the optimal values, and as much again below them.
  const range = () => {
    const { matters, optimum } = chosen();
    const values = optimum.values.filter((_, state) => matters[state] === "1");
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const lowest = Math.min(...chosen().runs.flatMap((run) => run.values.map((map) => Math.min(...map.filter((_, s) => matters[s] === "1")))));
    return [Math.max(low - (high - low || 1), Math.min(lowest, low)), high];
  };
  const shade = (value, [low, high]) => {
    const share = Math.round(100 * Math.min(Math.max((value - low) / (high - low || 1), 0), 1));
    return `color-mix(in oklab, var(--map-high) ${share}%, var(--map-low))`;
  };

  const arrow = ([down, right], isBest) =>
    element("path", {
      class: isBest ? "arrow" : "arrow wrong",
      // To stay is a ring.
      d: down || right ? "M-.26,0H.24M.08,-.15L.25,0L.08,.15" : "M-.12,0a.12,.12 0 1 0 .24,0a.12,.12 0 1 0 -.24,0",
      transform: `rotate(${(Math.atan2(down, right) * 180) / Math.PI})`,
    });
  const GLYPHS = { G: "★", X: "✕", P: "◆", S: "" };

  const drawCell = (map, cell, colours) => {
    const { rows, moves, matters, layers } = chosen();
    const width = rows[0].length;
    const [x, y] = [cell % width, Math.floor(cell / width)];
    const collected = layers[Number(layer.lastElementChild.value)].includes(cell);
    const letter = collected ? "." : rows[y][x];
    const state = firstState() + cell;
    const group = element("g", { transform: `translate(${x + 0.5},${y + 0.5})`, "data-cell": cell });
    const square = element("rect", { x: -0.5, y: -0.5, width: 1, height: 1, class: `tile tile-${{ "#": "wall", G: "goal", X: "trap", P: "prize" }[letter] ?? "free"}` });
    group.append(square);
    if (matters[state] === "1") {
      square.style.fill = shade(map.value(state), colours);
      const best = bestActions(state);
      const actions = map.actions(state);
      const isRight = actions.every((action) => best.includes(action));
      if (!isRight) {
        group.append(element("rect", { x: -0.46, y: -0.46, width: 0.92, height: 0.92, class: "differs" }));
        group.append(element("path", { d: "M.5,-.5V-.18L.18,-.5Z", class: "wrong-corner" })); // told apart without colour
      }
      group.append(...actions.map((action) => arrow(moves[action], isRight)));
      if (letter === "S") group.append(element("circle", { r: 0.42, class: "start" }));
    }
    if (GLYPHS[letter]) group.append(element("text", { class: "glyph" }, GLYPHS[letter]));
    return group;
  };

  const drawBoard = (map, colours) => {
    const { rows, matters } = chosen();
    const [height, width] = [rows.length, rows[0].length];
    const cells = Array.from({ length: nCells() }, (_, cell) => cell);
    const seen = cells.filter((cell) => matters[firstState() + cell] === "1");
    const wrong = seen.filter((cell) => {
      const best = bestActions(firstState() + cell);
      return !map.actions(firstState() + cell).every((action) => best.includes(action));
    });
    const figure = document.createElement("div");
    figure.className = "board";
    figure.style.setProperty("--columns", width);
    const title = document.createElement("h3");
    const name = document.createElement("span");
    name.className = "agent";
    if (map.mark !== undefined) {
      const swatch = document.createElement("span");
      swatch.className = "swatch";
      swatch.dataset.colour = map.mark.colour;
      swatch.dataset.shape = map.mark.shape;
      name.append(swatch);
    }
    name.append(map.title);
    title.append(name);
    const note = document.createElement("p");
    note.className = "note";
    note.textContent =
      map.mark === undefined ? "all optimal actions" : `${seen.length - wrong.length} of ${seen.length} cells optimal`;
    const picture = element("svg", { viewBox: `-.04 -.04 ${width + 0.08} ${height + 0.08}`, role: "img", tabindex: 0, "aria-label": `${map.title}: ${note.textContent}` });
    picture.append(...cells.map((cell) => drawCell(map, cell, colours)));
    figure.append(title, picture, note);
    return figure;
  };

  const draw = () => {
    const colours = range();
    boards.replaceChildren(...maps.map((map) => drawBoard(map, colours)));
    const text = `after ${moment().toLocaleString("en")} steps`;
    output.textContent = text;
    slider.setAttribute("aria-valuetext", text);
    root.querySelector(".moment").textContent = `Policies ${text} of the run with seed ${seed.lastElementChild.value}.`;
    root.querySelector(".range").textContent = `${report.number(colours[0])} or less to ${report.number(colours[1])}`;
  };

  const chooseRuns = () => {
    maps = makeMaps();
    const wasLast = moments.length === 0 || Number(slider.value) === moments.length - 1;
    const before = moment();
    moments = [...new Set(runs().flatMap((run) => run.steps))].sort((a, b) => a - b);
    slider.max = moments.length - 1;
    slider.value = wasLast ? moments.length - 1 : Math.max(moments.findLastIndex((step) => step <= before), 0);
    draw();
  };

  const chooseEnvironment = () => {
    stop();
    root.querySelector(".maps").hidden = chosen() === null;
    readout.textContent = still;
    if (chosen() === null) return;
    const seeds = [...new Set(chosen().runs.map((run) => run.seed))];
    fill(seed, seeds.map((value) => [value, String(value)]));
    fill(layer, chosen().layers.map((cells, i) => [i, cells.map(place).join("; ") || "nothing"]));
    const words = { X: "✕", P: "◆", "#": "■", G: "★" };
    const names = { G: "goal", ...chosen().names };
    root.querySelector(".tiles").textContent = `${Object.entries(names).map(([letter, name]) => `${words[letter]} ${name}`).join(", ")}, ring: start.`;
    moments = [];
    chooseRuns();
  };

  const stop = () => {
    clearInterval(timer);
    timer = null;
    play.textContent = "Play";
    play.setAttribute("aria-pressed", "false");
  };
  const step = () => {
    slider.value = Number(slider.value) + 1;
    draw();
    if (Number(slider.value) >= moments.length - 1) stop();
  };
  play.addEventListener("click", () => {
    if (timer !== null) {
      stop();
      return;
    }
    if (Number(slider.value) >= moments.length - 1) slider.value = 0;
    draw();
    play.textContent = "Stop";
    play.setAttribute("aria-pressed", "true");
    timer = setInterval(step, 500);
  });

  const tell = (cell) => {
    const state = firstState() + cell;
    const figures = chosen().matters[state] !== "1" ? "no action is taken here" : maps
      .map((map) => `${map.title} ${report.number(map.value(state))} (${map.actions(state).map((action) => word(chosen().moves[action])).join(" or ")})`)
      .join(" · ");
    readout.textContent = `${place(cell)}: ${figures}`;
  };
  boards.addEventListener("pointerover", (event) => {
    const cell = Number(event.target.closest("[data-cell]")?.dataset.cell ?? NaN);
    if (!Number.isNaN(cell)) tell(cell);
  });
  // The arrows go from cell to cell, on all maps at once.
  let cursor = null;
  const point = () => {
    boards.querySelectorAll(".cursor").forEach((old) => old.remove());
    if (cursor === null) return;
    boards.querySelectorAll(`[data-cell="${cursor}"]`).forEach((cell) =>
      cell.append(element("rect", { x: -0.45, y: -0.45, width: 0.9, height: 0.9, class: "cursor" })),
    );
    readout.setAttribute("aria-live", "polite");
    tell(cursor);
  };
  boards.addEventListener("keydown", (event) => {
    const [height, width] = [chosen().rows.length, chosen().rows[0].length];
    const move = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key];
    if (move === undefined || event.target.closest(".board svg") === null) return;
    event.preventDefault();
    const [row, column] = cursor === null ? [0, 0] : [Math.floor(cursor / width) + move[0], (cursor % width) + move[1]];
    cursor = Math.min(Math.max(row, 0), height - 1) * width + Math.min(Math.max(column, 0), width - 1);
    point();
  });
  boards.addEventListener("focusout", () => {
    cursor = null;
    point();
    readout.textContent = still;
  });
  boards.addEventListener("pointerleave", () => {
    readout.textContent = still;
  });
  slider.addEventListener("input", () => {
    stop();
    draw();
  });
  seed.lastElementChild.addEventListener("change", chooseRuns);
  layer.lastElementChild.addEventListener("change", draw);
  let environment = report.environment;
  report.onChange(() => {
    if (report.environment === environment) return;
    environment = report.environment;
    chooseEnvironment();
  });
  chooseEnvironment();
});
