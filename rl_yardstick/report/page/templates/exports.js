// Exports: figures as pictures with title and legend, tables as CSV.
(() => {
  const slug = (text) => text.trim().toLowerCase().replace(/[^\p{L}\p{N}.]+/gu, "-").replace(/^-|-$/g, "");
  const visible = (element) => element.textContent.replace(/\s+/g, " ").trim();

  // The section's heading, with the chosen environment.
  const heading = (element) => {
    const title = element.closest("section").querySelector("h2");
    const place = title.querySelector(".where:not([hidden])");
    return [title.firstChild.textContent.trim(), ...(place ? [visible(place)] : [])].join(" · ");
  };
  const fileName = (element, number = []) => slug([document.title, heading(element), ...number].join(" ")).slice(0, 120);
  const placeOf = (element, css) => {
    const all = [...element.closest("section").querySelectorAll(css)].filter((one) => one.closest("[hidden]") === null);
    return all.length > 1 ? [all.indexOf(element) + 1] : [];
  };

  report.fileName = fileName;
  report.download = (name, blob) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  };

  // The figure as on the page, with its title and legend.
  report.picture = async (plot, format) => {
    const { width, height } = plot.getBoundingClientRect();
    const named = plot.data.filter((trace) => trace.name);
    const hasLegend = named.length > 1 && plot.layout.yaxis.ticktext === undefined;
    const layout = {
      ...plot.layout,
      title: { text: report.text(heading(plot)), x: 0.01, xanchor: "left", font: { size: 16 } },
      margin: { ...plot.layout.margin, t: 64, ...(hasLegend && { b: 96 }) },
      paper_bgcolor: report.css("--card"),
      showlegend: hasLegend,
      legend: { orientation: "h", y: -0.2, yanchor: "top" },
      height: height + 26 + (hasLegend ? 50 : 0),
      width,
    };
    const data = plot.data.map((trace) => ({ ...trace, showlegend: Boolean(trace.name) }));
    const uri = await Plotly.toImage({ data, layout }, { format, scale: format === "png" ? 2 : 1, width: layout.width, height: layout.height });
    const name = `${fileName(plot, placeOf(plot, ".plot"))}.${format}`;
    const [kind, content] = uri.slice(5).split(/,(.*)/s);
    const bytes = kind.endsWith("base64")
      ? Uint8Array.from(atob(content), (letter) => letter.charCodeAt(0))
      : new TextEncoder().encode(decodeURIComponent(content));
    return { name, blob: new Blob([bytes], { type: kind.split(";")[0] }) };
  };
  report.savePicture = async (plot, format) => {
    const { name, blob } = await report.picture(plot, format);
    report.download(name, blob);
  };

  // A table as comma-separated values: small print has a column of its own.
  const own = (cell) => visible({ textContent: [...cell.childNodes].filter((node) => node.nodeName !== "SMALL" && isHeard(node)).map((node) => node.textContent).join("") });
  const small = (cell) => (cell.querySelector("small") ? visible(cell.querySelector("small")) : "");
  const quoted = (text) => {
    // A spreadsheet would take such a text for a formula.
    const safe = /^[=+@\t]|^-[^\d.∞]/.test(text) ? `'${text}` : text;
    return /[",\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
  };
  const isHeard = (element) => element.getAttribute?.("aria-hidden") !== "true";
  report.csv = (table) => {
    const cellsOf = (row) => [...row.cells].filter(isHeard);
    const rows = [...table.rows].filter((row) => row.parentElement.tagName !== "THEAD").map(cellsOf);
    const headings = cellsOf(table.tHead.rows[0]);
    const hasSmall = headings.map((_, i) => rows.some((cells) => cells[i] && small(cells[i]) !== ""));
    const split = (cells, first, second) => cells.flatMap((cell, i) => (hasSmall[i] ? [first(cell), second(cell)] : [first(cell)]));
    const title = (cell) => [own(cell), small(cell)].filter((text) => text !== "").join(", ");
    const figure = (cell) => {
      const value = cell.dataset.value;
      return value === undefined || cell.tagName === "TH" || Number.isNaN(Number(value.replace("inf", "Infinity"))) ? own(cell) : value;
    };
    const lines = [split(headings, title, (cell) => `${own(cell)}: small print`), ...rows.map((cells) => split(cells, figure, small))];
    return lines.map((line) => line.map(quoted).join(",")).join("\n") + "\n";
  };

  document.querySelectorAll("figure .scroll table").forEach((table) => {
    const button = document.createElement("button");
    button.type = "button";
    button.className = "export screen-only";
    button.textContent = "Save as CSV";
    button.addEventListener("click", () => {
      const name = `${fileName(table, placeOf(table, "figure .scroll table"))}.csv`;
      report.download(name, new Blob([report.csv(table)], { type: "text/csv" }));
    });
    table.closest(".scroll").after(button);
  });
})();
