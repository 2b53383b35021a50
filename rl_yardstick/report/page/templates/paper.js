// On paper there is nothing to choose: every environment is printed, with its figures laid out anew
// for the width of a page.
(() => {
  const WIDTH = 660; // CSS pixels: A4 and Letter have more between their margins
  const sections = [...document.querySelectorAll("section[data-places]")];
  let sheets = null;

  // A static copy of a section, without controls: radio buttons of one name would uncheck those on the
  // screen. Ids, by which drawings refer to their own parts, are renamed so that none is there twice.
  const still = (section, place) => {
    const sheet = section.cloneNode(true);
    sheet.querySelectorAll(".controls").forEach((controls) => controls.remove());
    sheet.querySelectorAll("[data-still]").forEach((film) => (film.querySelector("img").src = film.dataset.still));
    sheet.innerHTML = sheet.innerHTML
      .replace(/\bid="/g, `id="on-paper-${place}-`)
      .replace(/url\((&quot;|["']?)#/g, `url($1#on-paper-${place}-`);
    ["id", "data-places"].forEach((name) => sheet.removeAttribute(name));
    sheet.className = "sheet";
    return sheet;
  };

  let chosen = 0;
  let folded = [];
  const lay = () => {
    if (sheets !== null) return;
    sheets = [];
    chosen = report.environment;
    report.paper = (element) => ({
      width: Math.min(WIDTH, element.closest(".pair") ? WIDTH / 2 : WIDTH),
      ...(element.classList.contains("tall") && { height: 380 }),
      autosize: false,
    });
    theme.forPaper(true);
    folded = [...document.querySelectorAll("details:not([open])")];
    folded.forEach((details) => (details.open = true));
    report.page.environments.forEach((_, place) => {
      report.choose(place);
      report.drawAll();
      sheets.push(sections.map((section) => still(section, place)));
    });
    sections.forEach((section, i) => section.after(...sheets.map((sheet) => sheet[i])));
    document.documentElement.classList.add("on-paper");
  };
  const clear = () => {
    if (sheets === null) return;
    sheets.flat().forEach((sheet) => sheet.remove());
    sheets = null;
    folded.forEach((details) => (details.open = false));
    report.paper = undefined;
    document.documentElement.classList.remove("on-paper");
    theme.forPaper(false);
    report.choose(chosen);
  };

  window.addEventListener("beforeprint", lay);
  window.addEventListener("afterprint", clear);
  // A browser's tools show a page as on paper without those two events.
  matchMedia("print").addEventListener("change", ({ matches }) => (matches ? lay() : clear()));
})();
