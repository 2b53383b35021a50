// All verdicts, to be taken along.
report.section("verdict", (root, files) => {
  root.querySelector(".exports").hidden = false;
  root.querySelectorAll("[data-suffix]").forEach((button) =>
    button.addEventListener("click", () => {
      const { suffix } = button.dataset;
      report.download(`${report.fileName(button)}.${suffix}`, new Blob([files[suffix]], { type: "text/plain" }));
    }),
  );
});
