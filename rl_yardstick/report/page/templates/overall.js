report.section("overall", (root, data) => {
  report.figure(root.querySelector("#aggregate"), () => {
    // A score far below the best random or constant policy would leave no room for the others.
    const { traces, yaxis, height } = report.intervals(data.means, { least: -0.5 });
    return {
      traces,
      layout: { height: Math.max(height, 320), hovermode: "closest", xaxis: { title: { text: "mean score" } }, yaxis },
    };
  });
  report.figure(root.querySelector("#profiles"), () => ({
    traces: data.agents.map((label) => ({
      x: data.thresholds,
      y: data.profiles[label],
      name: report.text(label),
      mode: "lines",
      line: { color: report.colour(label), width: 2.2, dash: report.mark(label).dash },
    })),
    layout: {
      height: Math.max(74 + 46 * data.agents.length, 320),
      hovermode: "x unified",
      xaxis: { title: { text: "score" }, hoverformat: ".2f" },
      yaxis: { title: { text: "share of runs with a higher score" }, range: [0, 1.02], tickformat: ".0%" },
    },
  }));
});
