// The figures of a tuning's page.

// A name on several lines, broken after its words.
const inLines = (name) => {
  const lines = [""];
  for (const word of name.split(/(?<=[_.])/)) {
    if (lines.at(-1) !== "" && lines.at(-1).length + word.length > 13) lines.push("");
    lines[lines.length - 1] += word;
  }
  return lines.map(report.text).join("<br>");
};

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
      label: { text: `shipped ${report.number(shipped)}${isBeyond(shipped) ? ", beyond the edge" : ""}`, textposition: "end", xanchor: "right", yanchor: isCost ? "top" : "bottom", font: { size: 11, color: muted } },
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

report.section("parallel", (root, data) => {
  const BELOW = -0.12; // where a parameter is not there
  const small = matchMedia("(max-width: 40rem)");
  const build = () => {
    const n = Math.min(data.axes.length, small.matches ? 4 : 8);
    const rest = data.axes.slice(n).map((axis) => axis.name);
    root.querySelector(".detail").textContent = rest.length ? `Not drawn: ${rest.join(", ")}.` : "";
    const axes = data.axes.slice(0, n);
    // Lines with the same value are drawn side by side.
    const height = (line, i) => (line.at[i] === null ? BELOW : line.at[i]) + 0.015 * (((line.number * 7) % 5) - 2);
    const trace = (lines, style) => ({
      mode: "lines",
      hoverinfo: "text",
      x: lines.flatMap(() => [...axes.keys(), null]),
      y: lines.flatMap((line) => [...axes.map((_, i) => height(line, i)), null]),
      text: lines.flatMap((line) => [...axes.map((axis, i) => report.text(`${line.text}; ${axis.name}: ${line.said[i]}`)), ""]),
      line: style,
    });
    const accent = report.css("--accent");
    const special = data.lines.filter((line) => line.number === 0 || line.number === data.winner);
    const groups = Array.from({ length: data.groups }, (_, group) =>
      trace(
        data.lines.filter((line) => line.group === group && !special.includes(line)),
        { color: report.fade(accent, 0.12 + (0.6 * group) / data.groups), width: 1.3 },
      ),
    );
    const named = special.map((line) =>
      line.number === data.winner
        ? trace([line], { color: report.css("--agent-1"), width: 3.5 })
        : trace([line], { color: report.css("--ink"), width: 2, dash: "dash" }),
    );
    const ticks = axes.flatMap((axis, i) =>
      axis.ticks.map(([y, text]) => ({
        x: i, y, text: report.text(text), showarrow: false, xanchor: i === n - 1 ? "right" : "left", xshift: i === n - 1 ? -4 : 4,
        font: { size: 11, color: report.css("--ink") }, bgcolor: report.fade(report.css("--card"), 0.75), borderpad: 1,
      })),
    );
    return {
      traces: [...groups, ...named],
      layout: {
        hovermode: "closest",
        annotations: ticks,
        margin: { l: 24, r: 24, t: 24, b: 60 },
        xaxis: {
          tickvals: [...axes.keys()],
          ticktext: axes.map((axis) => inLines(axis.name)),
          tickangle: 0,
          tickfont: { size: 11 },
          range: [-0.15, n - 0.85],
          gridcolor: report.css("--muted"),
          showline: false,
          fixedrange: true,
          ticks: "",
        },
        yaxis: { visible: false, range: [BELOW - 0.08, 1.08], fixedrange: true },
      },
    };
  };
  const redraw = report.figure(root.querySelector(".plot"), build);
  small.addEventListener("change", redraw);
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
