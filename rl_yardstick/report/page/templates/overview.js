// The small figures choose the environment that the sections below show.
report.section("overview", (root) => {
  const buttons = [...root.querySelectorAll("[data-choose]")];
  const select = document.getElementById("environment");
  const mark = () => buttons.forEach((button, i) => button.setAttribute("aria-pressed", String(i === report.environment)));
  buttons.forEach((button, i) =>
    button.addEventListener("click", () => {
      select.value = i;
      report.choose(i);
    }),
  );
  report.onChange(mark);
  mark();
});
