// Drawing with Plotly in the colours of the page.
(() => {
  const CONFIG = {
    responsive: true,
    displaylogo: false,
    displayModeBar: "hover",
    modeBarButtonsToRemove: [
      "toImage", // those below have a title and a legend
      "select2d", "lasso2d", "autoScale2d", "zoomIn2d", "zoomOut2d",
      "sendChartToCloud", // a page that needs no network offers none
    ],
    modeBarButtonsToAdd: ["svg", "png"].map((format) => ({
      name: format,
      title: `Save as ${format.toUpperCase()}`,
      icon: format === "svg" ? Plotly.Icons.disk : Plotly.Icons.camera,
      click: (plot) => report.savePicture(plot, format),
    })),
  };
  const narrow = matchMedia("(max-width: 40rem)");
  narrow.addEventListener("change", () => report.changed());

  const axis = () => ({
    gridcolor: report.css("--soft"),
    linecolor: report.css("--line"),
    zeroline: false,
    showline: true,
    ticks: "outside",
    tickcolor: report.css("--line"),
    automargin: true,
    separatethousands: true,
    spikecolor: report.css("--muted"),
    spikethickness: 1,
  });

  // Figures are drawn when they come near the window, and not all at once.
  const figures = new Map();
  const nearness = new IntersectionObserver(
    (entries) => entries.forEach((entry) => figures.get(entry.target).come(entry.isIntersecting)),
    { rootMargin: "50% 0px" },
  );
  report.drawAll = () => figures.forEach((figure) => figure.draw());

  // Draws the traces and layout that `build` returns into the element, and again after each change.
  // Hides the figure if there is nothing to draw. Returns a function that redraws it.
  report.figure = (element, build, isThere = () => true) => {
    let isNear = false;
    let isStale = true;
    const draw = () => {
      if (!isStale) return;
      isStale = false;
      const { traces, layout } = build();
      const { xaxis, yaxis, ...rest } = { ...layout, ...report.paper?.(element) };
      // Plotly takes the element's height when the window changes.
      element.style.height = rest.height === undefined ? "" : `${rest.height}px`;
      Plotly.react(
        element,
        traces,
        {
          paper_bgcolor: "rgba(0,0,0,0)",
          plot_bgcolor: "rgba(0,0,0,0)",
          font: { family: getComputedStyle(document.body).fontFamily, size: 13, color: report.css("--ink") },
          margin: { l: 50, r: 14, t: 54, b: 46 },
          showlegend: false,
          modebar: { bgcolor: "rgba(0,0,0,0)", color: report.css("--muted"), activecolor: report.css("--accent") },
          hoverlabel: { bgcolor: report.css("--card"), bordercolor: report.css("--line"), font: { color: report.css("--ink") } },
          ...rest,
          xaxis: { ...axis(), ...xaxis },
          yaxis: { ...axis(), ...yaxis },
        },
        CONFIG,
      );
    };
    const update = () => {
      isStale = isThere();
      element.closest("figure").hidden = !isStale;
      if (isNear) draw();
    };
    const come = (isHere) => {
      isNear = isHere;
      if (isNear) draw();
    };
    figures.set(element, { draw, come });
    nearness.observe(element);
    report.onChange(update);
    update();
    return update;
  };

  // Plotly reads tags and entities in its texts.
  report.text = (label) =>
    label.replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");

  // A label for an axis, on several lines where it is long.
  report.tick = (label) => {
    const width = narrow.matches ? 12 : 28;
    const lines = [];
    const words = label.split(/(?<=[ _,=-])/).flatMap((word) => word.match(new RegExp(`.{1,${width}}`, "gu")) ?? []);
    for (const word of words) {
      const last = lines.length - 1;
      if (last >= 0 && lines[last].length + word.length <= width) lines[last] += word;
      else lines.push(word);
    }
    return lines.map(report.text).join("<br>");
  };

  report.fade = (colour, alpha) => {
    const parts = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
    return `rgba(${parts.join(",")},${alpha})`;
  };

  // The interval of a curve as a surface, and the curve itself.
  // A curve with a `note` has circles along it.
  report.band = (label, curve, height, line = {}, note = "") => {
    const colour = report.colour(label);
    const seen = curve.x.map((_, i) => i).filter((i) => curve.low[i] !== null);
    const traces = [];
    if (seen.length > 1) {
      const back = seen.toReversed();
      traces.push({
        x: [...seen, ...back].map((i) => curve.x[i]),
        y: [...seen.map((i) => height(curve.high[i])), ...back.map((i) => height(curve.low[i]))],
        fill: "toself",
        fillcolor: report.fade(colour, 0.18),
        line: { width: 0 },
        mode: "lines",
        hoverinfo: "skip",
      });
    }
    traces.push({
      x: curve.x,
      y: curve.y.map(height),
      name: report.text(note === "" ? label : `${label} (${note})`),
      text: curve.y.map((point, i) => report.interval({ point, low: curve.low[i], high: curve.high[i] })),
      hovertemplate: "%{text}",
      mode: curve.x.length === 1 ? "markers" : note === "" ? "lines" : "lines+markers",
      line: { color: colour, width: 2.2, dash: report.mark(label).dash, ...line },
      marker: { color: colour, size: 9, ...(note !== "" && { symbol: "circle-open", line: { width: 2 }, maxdisplayed: 10 }) },
    });
    return traces;
  };

  const optimumName = ({ optimum, optimum_at_least: least, optimum_is_proven: isProven }) =>
    least === null
      ? `optimum ${report.number(optimum)}`
      : `optimum between ${report.number(least)} and ${report.number(optimum)}${isProven ? "" : " (not proven)"}`;

  // The optimum and the best random or constant policy as lines: horizontal, or vertical if the middle of the
  // x axis is given, which puts their names inside the figure and not over each other.
  report.references = (environment, height, middle = null) =>
    [
      { name: optimumName(environment), value: environment.optimum, dash: "solid", isUpper: true },
      { name: "", value: environment.optimum_at_least, dash: "dash", isUpper: true },
      { name: `best random or constant policy ${report.number(environment.baseline)}`, value: environment.baseline, dash: "dot", isUpper: false },
    ]
      .filter(({ value }) => value !== null)
      .map(({ name, value, dash, isUpper }) => {
        const at = height(value);
        const place =
          middle === null
            ? { xref: "paper", x0: 0, x1: 1, y0: at, y1: at }
            : { yref: "paper", y0: 0, y1: 1, x0: at, x1: at };
        const side =
          middle === null
            ? { textposition: "end", xanchor: "right", yanchor: isUpper ? "bottom" : "top" }
            : { textposition: isUpper ? "end" : "start", xanchor: at > middle ? "right" : "left", yanchor: "bottom" };
        return {
          type: "line",
          ...place,
          line: { color: report.css("--muted"), width: 1.4, dash },
          label: { text: name, textangle: 0, font: { size: 11, color: report.css("--muted") }, ...side },
        };
      });

  // An axis that is linear up to a magnitude and logarithmic beyond.
  report.symlog = (linear) => {
    const height = (value) => {
      if (value === null) return null;
      const size = Math.abs(value) / linear;
      return Math.sign(value) * (size <= 1 ? size : 1 + Math.log10(size));
    };
    const ticks = (low, high) => {
      const step = 10 ** Math.floor(Math.log10(linear));
      const values = [0];
      const inner = step * (linear / step >= 5 ? 5 : linear / step >= 2 ? 2 : 1);
      values.push(inner, -inner);
      for (let size = step * 10; size <= Math.max(Math.abs(low), Math.abs(high)); size *= 10) {
        values.push(size, -size);
      }
      // Powers of ten come first: no tick is printed over another.
      const room = 0.09 * (height(high) - height(low));
      const order = [0, ...values.slice(3).reverse(), inner, -inner];
      const shown = order
        .filter((value) => value >= low && value <= high)
        .reduce((kept, value) => (kept.every((other) => Math.abs(height(other) - height(value)) >= room) ? [...kept, value] : kept), []);
      return { tickvals: shown.map(height), ticktext: shown.map(report.number) };
    };
    return { height, ticks };
  };

  // Buttons that hide and show agents, with the note of `noteOf`. Returns functions that tell
  // whether an agent is shown, and that fill the legend again.
  report.legend = (root, redraw, noteOf = () => "") => {
    const hidden = new Set();
    const fill = () => {
      root.replaceChildren(
        ...report.page.environments[report.environment].agents.map((label) => {
          const button = document.createElement("button");
          button.type = "button";
          const dash = { solid: "", dash: "6 3", dashdot: "6 3 1 3", dot: "2 3" }[report.mark(label).dash];
          const line = document.createElementNS("http://www.w3.org/2000/svg", "svg");
          line.setAttribute("aria-hidden", "true");
          line.innerHTML = `<line x1="0" x2="100%" y1="50%" y2="50%" stroke="var(--agent)" stroke-width="3" stroke-dasharray="${dash}"/>`;
          line.dataset.colour = report.mark(label).colour;
          const note = noteOf(label);
          if (note !== "") line.innerHTML += `<circle cx="50%" cy="50%" r="4" fill="var(--card)" stroke="var(--agent)" stroke-width="2"/>`;
          button.append(line, label, ...(note === "" ? [] : [Object.assign(document.createElement("small"), { textContent: note })]));
          button.setAttribute("aria-pressed", String(!hidden.has(label)));
          button.addEventListener("click", () => {
            if (!hidden.delete(label)) hidden.add(label);
            button.setAttribute("aria-pressed", String(!hidden.has(label)));
            redraw();
          });
          return button;
        }),
      );
    };
    report.onChange(fill);
    fill();
    return { isShown: (label) => !hidden.has(label), fill };
  };

  // Dots with intervals, an agent on each line.
  report.intervals = (rows, { height: heightOf = (value) => value, spread = 0.22, least = -Infinity } = {}) => {
    const height = (value) => heightOf(Math.max(value, least));
    const traces = [];
    rows.forEach((row, i) => {
      const place = rows.length - 1 - i;
      const colour = report.colour(row.agent);
      if (row.low !== null) {
        // A bar of no length is invisible: a diamond.
        traces.push({
          x: [height(row.low), height(row.high)],
          y: [place, place],
          mode: row.low < row.high ? "lines" : "markers",
          line: { color: report.fade(colour, 0.35), width: 12 },
          marker: { symbol: "diamond", size: 15, color: report.fade(colour, 0.35) },
          hoverinfo: "skip",
        });
      }
      const runs = row.runs ?? [];
      if (runs.length) {
        traces.push({
          x: runs.map(height),
          y: runs.map((_, k) => place + (runs.length > 1 ? spread * ((2 * k) / (runs.length - 1) - 1) : 0)),
          mode: "markers",
          marker: { color: colour, size: 6, opacity: 0.75 },
          text: runs.map((value, k) => `seed ${row.seeds[k]}: ${report.number(value)}`),
          hovertemplate: "%{text}<extra></extra>",
        });
      }
      traces.push({
        x: [height(row.point)],
        y: [place],
        mode: "markers",
        marker: { symbol: row.point < least ? "triangle-left" : "line-ns", size: row.point < least ? 9 : 18, color: colour, line: { color: colour, width: 3.5 } },
        text: [report.interval(row)],
        name: report.text(row.agent),
        hovertemplate: "mean %{text}",
      });
    });
    return {
      traces,
      height: 114 + 46 * rows.length,
      yaxis: {
        tickvals: rows.map((_, i) => rows.length - 1 - i),
        ticktext: rows.map((row) => report.tick(row.agent)),
        range: [-0.6, rows.length - 0.4],
        fixedrange: true,
        showgrid: false,
        ticks: "",
      },
    };
  };
})();
