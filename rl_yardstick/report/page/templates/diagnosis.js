report.section("diagnosis", (root, meanings, place) => {
  const select = root.querySelector("select");
  const scale = () => root.querySelector('input[name="compared-scale"]:checked').value;
  const column = () => (place() ?? {})[select.value] ?? {};
  let redraw = () => {};
  const { isShown } = report.legend(root.querySelector(".legend"), () => redraw());
  const fill = () => {
    const chosen = select.value;
    const names = Object.keys(meanings).filter((name) => name in (place() ?? {}));
    select.replaceChildren(...names.map((name) => new Option(meanings[name], name)));
    if (names.includes(chosen)) select.value = chosen;
    root.querySelector(".controls").hidden = names.length === 0;
  };
  report.onChange(fill);
  fill();
  const build = () => ({
    traces: Object.entries(column())
      .filter(([label]) => isShown(label))
      .flatMap(([label, curve]) => report.band(label, curve, (value) => value)),
    layout: {
      hovermode: "x unified",
      uirevision: [report.environment, select.value, scale()].join(),
      xaxis: { title: { text: "environment steps" }, hoverformat: ",.4~r", exponentformat: "SI", rangemode: "tozero" },
      yaxis: { title: { text: meanings[select.value] }, type: scale(), exponentformat: "power" },
    },
  });
  redraw = report.figure(root.querySelector(".plot"), build, () => place() !== null);
  root.querySelectorAll("select, input").forEach((input) => input.addEventListener("change", redraw));
});
