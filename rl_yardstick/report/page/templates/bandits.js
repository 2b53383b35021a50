report.section("bandits", (root, _, current) => {
  const chosen = (name) => root.querySelector(`input[name="${name}"]:checked`).value;
  const same = (value) => value;
  const redraws = [];
  const redraw = () => redraws.forEach((draw) => draw());
  const { isShown } = report.legend(root.querySelector(".legend"), redraw);
  const agents = (items) => Object.entries(items).filter(([label]) => isShown(label));

  // A figure for the environments where `has` is true.
  const figure = (name, has, build) => {
    const element = root.querySelector(`#${name}`);
    redraws.push(report.figure(element, () => build(current()), () => current() !== null && has(current())));
  };

  const xaxis = (type = chosen("pull-axis")) => ({
    title: { text: type === "log" ? "pulls (log scale)" : "pulls" },
    type,
    hoverformat: ",",
    exponentformat: "SI",
    ...(type === "log" && { dtick: 1 }),
  });
  const ruler = (value, label) => ({
    type: "line",
    xref: "paper",
    x0: 0,
    x1: 1,
    y0: value,
    y1: value,
    line: { color: report.css("--muted"), width: 1.4 },
    label: {
      text: `${label} ${report.number(value)}`,
      textposition: "start",
      font: { size: 11, color: report.css("--muted") },
      yanchor: "top",
    },
  });
  const plain = (x, y) => ({ x, y, low: y.map(() => null), high: y.map(() => null) });
  const lines = ({ curves }, name) =>
    agents(curves).flatMap(([label, curve]) => report.band(label, plain(curve.x, curve[name]), same, { width: 1.6 }));
  const layout = (yaxis, more = {}) => ({ height: 360, hovermode: "x unified", xaxis: xaxis(), yaxis, ...more });

  figure("pull-reward", () => true, (item) => ({
    traces: lines(item, "reward"),
    layout: layout(
      { title: { text: "average reward per pull" } },
      { shapes: item.best === null ? [] : [ruler(item.best, "best possible")] },
    ),
  }));
  figure("pull-optimal", () => true, (item) => ({
    traces: lines(item, "optimal"),
    layout: layout({ title: { text: "runs that pull a best arm" }, range: [0, 1.02], tickformat: ".0%" }),
  }));

  const theory = (bounds, ceiling) => {
    const line = (name, y, dash) => {
      const kept = y.map((value) => (value <= ceiling ? value : null));
      return { x: bounds.pulls, y: kept, name, mode: "lines", line: { color: report.css("--muted"), width: 1.6, dash }, hovertemplate: "%{y:,.4~r}" };
    };
    return [line("Auer, for UCB1", bounds.auer, "dash"), line("Lai-Robbins slope", bounds.lai_robbins, "dot")];
  };
  figure("pull-regret", () => true, ({ curves, bounds }) => {
    const shown = agents(curves).map(([label, curve]) => [label, curve.regret[chosen("pull-spread")]]);
    // More bands than these would hide each other.
    const isFew = shown.length <= 4;
    const highest = Math.max(1, ...shown.flatMap(([, curve]) => (isFew ? curve.high : curve.y)));
    // An agent that never learns would leave no height for the others.
    const top = bounds === null ? Infinity : 1.1 * bounds.auer.at(-1);
    return {
      traces: [
        ...shown.flatMap(([label, curve]) => report.band(label, isFew ? curve : plain(curve.x, curve.y), same)),
        ...(bounds === null ? [] : theory(bounds, 1.5 * highest)),
      ],
      layout: layout({
        title: { text: "cumulative regret (reward)" },
        rangemode: "tozero",
        ...(highest > top && { range: [0, top] }),
      }),
    };
  });
  figure(
    "pull-simple",
    ({ curves }) => Object.values(curves).some((curve) => curve.simple.some((value) => value !== null)),
    (item) => ({
      traces: lines(item, "simple"),
      layout: layout({ title: { text: "simple regret (reward per pull)" }, rangemode: "tozero" }),
    }),
  );

  const armAxis = ({ arms }) => ({
    tickvals: arms.names.map((_, i) => i),
    ticktext: arms.names.map((name) => name.replace(", ", "<br>")),
    tickfont: { size: 11 },
    ...(arms.names.length <= 6 && { tickangle: 0 }),
    range: [-0.6, arms.names.length - 0.4],
    fixedrange: true,
    showgrid: false,
  });
  const hasArms = ({ arms }) => arms !== null;
  figure("arm-shares", hasArms, (item) => ({
    traces: agents(item.arms.shares).map(([label, y]) => ({
      type: "bar",
      x: y.map((_, i) => i),
      y,
      name: report.text(label),
      marker: { color: report.colour(label) },
      hovertemplate: "%{y:.1%}",
    })),
    layout: {
      height: 340,
      barmode: "group",
      hovermode: "x unified",
      xaxis: armAxis(item),
      yaxis: { title: { text: "share of the pulls" }, range: [0, 1.02], tickformat: ".0%" },
    },
  }));
  figure("arm-means", (item) => hasArms(item) && Object.keys(item.arms.estimates).length > 0, (item) => {
    const { means, estimates } = item.arms;
    const shown = agents(estimates);
    const offset = (k) => (shown.length > 1 ? 0.6 * (k / (shown.length - 1) - 0.5) : 0);
    return {
      traces: shown.map(([label, [mean, std]], k) => ({
        x: mean.map((_, i) => i + offset(k)),
        y: mean,
        name: report.text(label),
        mode: "markers",
        marker: { color: report.colour(label), size: 7 },
        error_y: { type: "data", array: std, color: report.colour(label), thickness: 1.5, width: 3 },
        text: mean.map((value, i) => `${report.number(value)} ± ${report.number(std[i])}`),
        hovertemplate: "%{text}",
      })),
      layout: {
        height: 340,
        hovermode: "closest",
        shapes: means.map((y, i) => ({ type: "line", x0: i - 0.42, x1: i + 0.42, y0: y, y1: y, layer: "below", line: { color: report.css("--ink"), width: 1.6 } })),
        xaxis: armAxis(item),
        yaxis: { title: { text: "mean reward per pull" } },
      },
    };
  });

  // Beliefs: of which agent, in which context, at which moment.
  const pick = (name) => root.querySelector(`.pick.${name} select`);
  const fill = (name, texts, index) => {
    pick(name).replaceChildren(...texts.map((text, i) => new Option(text, i)));
    pick(name).value = index;
    pick(name).parentElement.hidden = texts.length < 2;
  };
  const belief = () => current()?.beliefs[Number(pick("belief").value)];
  const fillMoments = () => {
    const item = belief();
    if (item === undefined) return;
    fill("context", item.true_means.map((_, i) => String(i)), 0);
    fill("moment", item.moments.map((moment) => `${moment.toLocaleString("en")} pulls`), item.moments.length - 1);
  };
  const fillBeliefs = () => {
    fill("belief", (current()?.beliefs ?? []).map((item) => item.agent), 0);
    fillMoments();
  };
  let before = report.environment;
  fillBeliefs();
  report.onChange(() => {
    root.querySelector(".pulls").hidden = current() === null;
    if (before === report.environment) return;
    before = report.environment;
    fillBeliefs();
  });
  root.querySelector(".pulls").hidden = current() === null;
  figure("pull-posteriors", ({ beliefs }) => beliefs.length > 0, () => {
    const item = belief();
    const [context, moment] = [Number(pick("context").value), Number(pick("moment").value)];
    const colour = (arm) => report.css(`--agent-${arm % 7}`);
    return {
      traces: item.densities[moment][context].map((y, arm) => ({
        x: item.points,
        y,
        name: `arm ${arm}`,
        mode: "lines",
        line: { color: colour(arm), width: 2.2 },
        hovertemplate: "%{y:,.3~r}",
      })),
      layout: {
        height: 340,
        showlegend: true,
        legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom" },
        hovermode: "x unified",
        shapes: item.true_means[context].flatMap((mean, arm) =>
          mean === null ? [] : [{ type: "line", yref: "paper", y0: 0, y1: 1, x0: mean, x1: mean, line: { color: colour(arm), width: 1.4, dash: "dot" } }],
        ),
        xaxis: { title: { text: "mean reward per pull" }, hoverformat: ".3f" },
        yaxis: { title: { text: "density" }, rangemode: "tozero" },
      },
    };
  });
  pick("belief").addEventListener("change", () => {
    fillMoments();
    redraw();
  });
  ["context", "moment"].forEach((name) => pick(name).addEventListener("change", redraw));
  root.querySelectorAll(".pulls input").forEach((input) => input.addEventListener("change", redraw));
});
