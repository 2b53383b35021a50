// The choice of an environment, means by a swept parameter, and the export of all verdicts.
report.section("verdict", (root, { files, metric, sweeps }) => {
  const buttons = [...root.querySelectorAll("[data-choose]")];
  const mark = () => buttons.forEach((button, i) => button.setAttribute("aria-pressed", String(i === report.environment)));
  buttons.forEach((button, i) =>
    button.addEventListener("click", () => {
      document.getElementById("environment").value = i;
      report.choose(i);
    }),
  );
  report.onChange(mark);
  mark();
  root.querySelectorAll(".plot").forEach((element) => {
    const curves = Object.entries(sweeps[element.dataset.card]);
    const values = [...new Set(curves.flatMap(([, curve]) => curve.x))].sort((a, b) => a - b);
    const isLog = values[0] > 0 && values.at(-1) >= 100 * values[0]; // two decades, as on paper
    const names = [...new Set(curves.map(([, curve]) => curve.parameter))];
    const reach = (middle, ends) => middle.map((y, i) => (ends[i] === null ? 0 : Math.abs(ends[i] - y)));
    report.figure(element, () => ({
      traces: [
        ...curves.map(([name, curve], k) => ({
          x: curve.x,
          y: curve.y,
          name: report.text(names.length > 1 ? `${name}, ${curve.parameter}` : name),
          mode: "lines+markers",
          line: { color: report.css(`--agent-${k % 7}`), width: 2, dash: ["solid", "dash", "dashdot", "dot"][k % 4] },
          error_y: { type: "data", symmetric: false, array: reach(curve.y, curve.high), arrayminus: reach(curve.y, curve.low), thickness: 1.5, width: 4 },
          hovertemplate: `${report.text(curve.parameter)} = %{x}: %{y:,.4~r}`,
        })),
        ...curves.map(([, curve]) => ({
          x: curve.x.filter((_, i) => curve.best[i]),
          y: curve.y.filter((_, i) => curve.best[i]),
          mode: "markers",
          marker: { symbol: "circle-open", size: 16, color: report.css("--ink"), line: { width: 2 } },
          hoverinfo: "skip",
          showlegend: false,
        })),
      ],
      layout: {
        height: 220,
        margin: { l: 50, r: 14, t: 30, b: 40 },
        showlegend: curves.length > 1,
        legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom" },
        hovermode: "closest",
        xaxis: {
          title: { text: report.text(names.length > 1 ? "value of the parameter" : names[0]) + (isLog ? " (log scale)" : "") },
          ...(isLog && { type: "log" }),
          ...(values.length <= 8 && { tickvals: values, ticktext: values.map((value) => String(Number(value.toPrecision(4)))) }),
        },
        yaxis: { title: { text: metric.replace(/(.{14}\S*) /g, "$1<br>"), font: { size: 11 } } },
      },
    }));
  });
  root.querySelector(".exports").hidden = false;
  root.querySelectorAll("[data-suffix]").forEach((button) =>
    button.addEventListener("click", () => {
      const { suffix } = button.dataset;
      report.download(`${report.fileName(button)}.${suffix}`, new Blob([files[suffix]], { type: "text/plain" }));
    }),
  );
});
