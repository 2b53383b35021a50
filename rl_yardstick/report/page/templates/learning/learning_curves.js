"use strict";

// A line through points (x, y) with x from 0 to 1, and a mark at the present moment.
const curveOf = (title, points) => {
  const finite = points.filter(([, y]) => y !== null && Number.isFinite(y));
  if (finite.length === 0) return null;
  const values = finite.map(([, y]) => y);
  const [low, high] = [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))];
  const height = (y) => (high > low ? 92 - (84 * (y - low)) / (high - low) : 50);
  const svg = drawn("svg", { viewBox: "0 0 1000 100", preserveAspectRatio: "none", role: "img" });
  // As many points as a screen can show.
  const stride = Math.max(Math.ceil(finite.length / 2000), 1);
  const kept = finite.filter((_, i) => i % stride === 0 || i === finite.length - 1);
  const line = drawn("polyline", { points: kept.map(([x, y]) => `${(1000 * x).toFixed(1)},${height(y).toFixed(1)}`).join(" ") });
  const now = drawn("line", { class: "now", x1: 0, x2: 0, y1: 0, y2: 100 });
  svg.append(line, now);
  svg.setAttribute("aria-label", `${title}: from ${shown(values[0])} to ${shown(values.at(-1))}, between ${shown(low)} and ${shown(high)}`);
  const caption = made("p");
  const present = made("span");
  caption.append(made("span", `${title} (${shown(low)} to ${shown(high)})`), present);
  // Show the last point up to the present moment.
  const go = (x) => {
    now.setAttribute("x1", 1000 * x);
    now.setAttribute("x2", 1000 * x);
    let [from, to] = [0, finite.length];
    while (from < to) {
      const middle = (from + to) >> 1;
      if (finite[middle][0] <= x + 1e-12) from = middle + 1;
      else to = middle;
    }
    present.textContent = from === 0 ? "–" : shown(finite[from - 1][1]);
  };
  return { elements: [caption, svg], go };
};
