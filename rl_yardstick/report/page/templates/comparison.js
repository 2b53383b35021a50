report.section("comparison", (root, data, chosen) => {
  report.figure(root.querySelector("#intervals"), () => {
    const { intervals: rows, linear } = chosen();
    const { optimum, baseline } = report.page.environments[report.environment];
    const values = rows.flatMap((row) => [row.low, row.high, ...row.runs]).filter((v) => v !== null);
    const drawn = [...values, optimum, baseline].filter((v) => v !== null);
    const symlog = linear === null ? null : report.symlog(linear);
    const height = symlog?.height ?? ((value) => value);
    const middle = (height(Math.min(...drawn)) + height(Math.max(...drawn))) / 2;
    const { traces, yaxis, height: pixels } = report.intervals(rows, { height });
    return {
      traces,
      layout: {
        height: pixels,
        hovermode: "closest",
        shapes: report.references(report.page.environments[report.environment], height, middle),
        xaxis: { title: { text: data.metric + (symlog ? ` (log scale beyond ±${report.number(linear)})` : "") }, ...symlog?.ticks(Math.min(...values), Math.max(...values, linear)) },
        yaxis,
      },
    };
  });
});
