// The button in a heading sorts its table, first with the best on top and then in reverse; rows
// without a value stay last.
for (const table of document.querySelectorAll("table.sortable")) {
  const headings = [...table.tHead.rows[0].cells];

  const compare = (one, other) => {
    const [a, b] = [Number(one), Number(other)];
    return Number.isNaN(a) || Number.isNaN(b) ? one.localeCompare(other) : a === b ? 0 : a - b;
  };
  // Python writes inf where JavaScript writes Infinity.
  const value = (row, column) => row.cells[column].dataset.value?.replace(/^(-?)inf$/, "$1Infinity");

  const sort = (column, sign) => {
    const rows = [...table.tBodies[0].rows];
    const known = rows.filter((row) => value(row, column) !== undefined);
    const rest = rows.filter((row) => value(row, column) === undefined);
    known.sort((one, other) => sign * compare(value(one, column), value(other, column)));
    table.tBodies[0].append(...known, ...rest);
    headings.forEach((heading) => heading.removeAttribute("aria-sort"));
    headings[column].setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
  };

  headings.forEach((heading, column) => {
    heading.querySelector("button").addEventListener("click", () => {
      const first = heading.dataset.bestFirst ?? "ascending";
      const order = { ascending: "descending", descending: "ascending" }[heading.ariaSort] ?? first;
      sort(column, order === "ascending" ? 1 : -1);
    });
  });
}
