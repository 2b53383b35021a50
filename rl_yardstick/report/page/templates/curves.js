report.section("curves", (root, _, place) => {
  const TITLES = { step: "environment steps", episode: "episodes", seconds: "wall time (s)" };
  const chosen = (name) => root.querySelector(`input[name="${name}"]:checked`).value;
  const figure = root.querySelector(".plot");
  const detail = root.querySelector(".detail");
  const scale = root.querySelector('[data-switch="scale"]');
  const legend = root.querySelector(".legend");
  let redraw = () => {};
  const noteOf = (label) => (place()?.[chosen("kind")].on_variant.includes(label) ? "on a variant" : "");
  const { isShown, fill } = report.legend(legend, () => redraw(), noteOf);

  const extent = (curves, environment) => {
    const values = curves.flatMap((curve) => [...curve.y, ...curve.low, ...curve.high]);
    const known = [...values, environment.optimum, environment.baseline].filter((v) => v !== null);
    return known.length ? [Math.min(...known), Math.max(...known)] : [0, 1];
  };

  const build = () => {
    const [kind, by, across] = ["kind", "by", "across"].map(chosen);
    const { by_axis: byAxis, linear_up_to: linear, on_variant: onVariant } = place()[kind];
    // Returns on a variant cannot be compared with the optimum of the environment itself.
    const judged = report.page.environments[report.environment];
    const environment = onVariant.length ? { ...judged, optimum: null, optimum_at_least: null, baseline: null } : judged;
    const symlog = linear !== null && chosen("scale") === "symlog" ? report.symlog(linear) : null;
    const height = symlog?.height ?? ((value) => value);
    const curves = Object.entries(byAxis[by]).filter(([label]) => isShown(label));
    detail.textContent = onVariant.length
      ? `Circles: trained on a variant of the environment, whose optimum may be another: ${onVariant.join(", ")}.`
      : "";
    return {
      traces: curves.flatMap(([label, curve]) => report.band(label, curve, height, {}, noteOf(label))),
      layout: {
        hovermode: "x unified",
        uirevision: [report.environment, kind, by, across, chosen("scale")].join(),
        shapes: report.references(environment, height),
        xaxis: { title: { text: TITLES[by] + (across === "log" ? " (log scale)" : "") }, type: across, hoverformat: ",.4~r", exponentformat: "SI", rangemode: "tozero" },
        yaxis: {
          title: { text: (kind === "evaluation" ? "return of evaluations" : "return of training episodes") + (symlog ? ` (log scale beyond ±${report.number(linear)})` : "") },
          ...symlog?.ticks(...extent(curves.map(([, curve]) => curve), environment)),
        },
      },
    };
  };
  let isChosen = false;
  const isThere = () => {
    // The axis of the budget, until the reader chooses another.
    if (!isChosen && place() !== null) root.querySelector(`input[name="by"][value="${place().evaluation.budget}"]`).checked = true;
    const isNone = place() !== null && Object.keys(place()[chosen("kind")].by_axis[chosen("by")]).length === 0;
    root.querySelector(".none").hidden = !isNone;
    root.querySelector(".controls").hidden = place() === null;
    scale.hidden = (place()?.[chosen("kind")].linear_up_to ?? null) === null;
    return place() !== null && !isNone;
  };
  redraw = report.figure(figure, build, isThere);
  root.querySelectorAll('input[name="by"]').forEach((input) => input.addEventListener("change", () => (isChosen = true)));
  root.querySelectorAll(".controls input").forEach((input) => input.addEventListener("change", redraw));
  root.querySelectorAll('input[name="kind"]').forEach((input) => input.addEventListener("change", fill));
});
