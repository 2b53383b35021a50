// The figures of a tuning's page.

report.section("history", (root, data) => {
  const { isCost, edge, numbers, texts, best, values, shipped, failed } = data;
  const shown = (value) => {
    if (value === null || edge === null) return value;
    return isCost ? Math.min(value, edge) : Math.max(value, edge);
  };
  const isBeyond = (value) => value !== null && shown(value) !== value;
  const dots = (name, marker) => ({
    x: numbers,
    y: values[name].map(shown),
    name,
    mode: "markers",
    text: texts,
    hovertemplate: "%{text}<extra></extra>",
    marker: {
      size: 8,
      ...marker,
      symbol: values[name].map((value) => (isBeyond(value) ? `triangle-${isCost ? "up" : "down"}` : "circle")),
    },
  });
  const words = [];
  const beyond = Object.values(values).flat().filter(isBeyond).length;
  if (beyond) words.push(`The axis shows where the best are told apart: ${beyond === 1 ? "a triangle at its edge is a trial" : `triangles at its edge are ${beyond} trials`} beyond it.`);
  if (failed.length) words.push(`Failed: ${failed.map((number) => `trial ${number}`).join(", ")}.`);
  root.querySelector(".detail").textContent = words.join(" ");
  report.figure(root.querySelector(".plot"), () => {
    const accent = report.css("--accent");
    const muted = report.css("--muted");
    const lines = shipped === null ? [] : [{
      type: "line", xref: "paper", x0: 0, x1: 1, y0: shown(shipped), y1: shown(shipped),
      line: { color: muted, width: 1.4, dash: "dot" },
      label: { text: `shipped ${report.number(shipped)}${isBeyond(shipped) ? ", beyond the edge" : ""}`, textposition: "start", xanchor: "left", yanchor: isCost ? "top" : "bottom", font: { size: 11, color: muted } },
    }];
    return {
      traces: [
        dots("ended early", { color: report.fade(report.css("--card"), 1), line: { color: muted, width: 1.5 } }),
        { x: numbers, y: best.map(shown), name: "best so far", mode: "lines", line: { color: accent, width: 2, shape: "hv" }, hoverinfo: "skip" },
        dots("judged on all seeds", { color: accent }),
      ],
      layout: {
        shapes: lines,
        margin: { l: 50, r: 14, t: 30, b: 46 },
        xaxis: { title: { text: "trial" }, rangemode: "tozero" },
        yaxis: { title: { text: data.figure } },
      },
    };
  });
});

report.section("importances", (root, data) => {
  report.figure(root.querySelector(".plot"), () => {
    const names = data.names.slice(0, 15);
    return {
      traces: [{
        type: "bar",
        orientation: "h",
        x: data.shares.slice(0, 15),
        y: names.map((_, i) => names.length - 1 - i),
        marker: { color: report.css("--accent") },
        text: data.shares.slice(0, 15).map((share) => `${Math.round(100 * share)} %`),
        textposition: "auto",
        textangle: 0,
        hoverinfo: "skip",
      }],
      layout: {
        height: 116 + (matchMedia("(max-width: 40rem)").matches ? 46 : 30) * names.length,
        margin: { l: 50, r: 14, t: 36, b: 46 },
        xaxis: { title: { text: "share" }, tickformat: ".0%", rangemode: "tozero", fixedrange: true },
        yaxis: {
          tickvals: names.map((_, i) => names.length - 1 - i),
          ticktext: names.map(report.tick),
          range: [-0.6, names.length - 0.4],
          fixedrange: true,
          showgrid: false,
          ticks: "",
        },
      },
    };
  });
});
