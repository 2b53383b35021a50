"use strict";

// Shared by all sections: their data, the chosen environment, the theme, agents' colours.
const report = (() => {
  // Data are parsed on first use: a page may hold those of a hundred curves.
  const known = new Map();
  const read = (name) => {
    if (!known.has(name)) {
      const element = document.getElementById(`data-${name}`);
      known.set(name, element === null ? null : JSON.parse(element.textContent));
    }
    return known.get(name);
  };
  const page = read("page");
  const marks = new Map(page.agents.map((mark) => [mark.label, mark]));
  const listeners = [];
  let environment = 0;

  const changed = () => listeners.forEach((listener) => listener());

  const choose = (index) => {
    environment = index;
    document.querySelectorAll("[data-environment]").forEach((element) => {
      element.hidden = Number(element.dataset.environment) !== index;
    });
    changed();
  };

  return {
    page,
    choose,
    changed,
    get environment() {
      return environment;
    },
    // If the page has the section, calls `start` with its element, its data, and a function that
    // returns the data of the chosen environment.
    section(name, start) {
      const root = document.getElementById(name);
      if (root !== null) start(root, read(name), () => read(`${name}-${environment}`));
    },
    // Calls `listener` whenever the environment or the theme has changed.
    onChange(listener) {
      listeners.push(listener);
    },
    css(name) {
      return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
    },
    mark(label) {
      return marks.get(label);
    },
    colour(label) {
      return this.css(`--agent-${marks.get(label).colour}`);
    },
    // A number with four significant digits, as the tables have them.
    number(value) {
      if (value === null || value === undefined) return "-";
      const digits = Math.abs(value) >= 1000 ? Math.round(value) : Number(value.toPrecision(4));
      return digits.toLocaleString("en", { maximumFractionDigits: 6 });
    },
    interval(item) {
      const number = report.number(item.point);
      if (item.low === null || item.low === item.high) return number;
      return `${number} [${report.number(item.low)}, ${report.number(item.high)}]`;
    },
  };
})();

// The button for the theme.
(() => {
  const button = document.getElementById("theme");
  const name = () => {
    button.textContent = `Theme: ${theme.choice}`;
  };
  theme.onChange(() => {
    name();
    report.changed();
  });
  button.hidden = false;
  button.addEventListener("click", () => theme.next());
  name();
})();

// The environment.
(() => {
  const select = document.getElementById("environment");
  select?.addEventListener("change", () => report.choose(Number(select.value)));
  report.choose(Number(select?.value ?? 0)); // a browser may remember another one
})();

// The section that is being read, in the bar.
(() => {
  const links = [...document.querySelectorAll(".bar nav a")];
  const observer = new IntersectionObserver(
    (entries) => {
      for (const entry of entries.filter((seen) => seen.isIntersecting)) {
        for (const link of links) {
          if (link.hash === `#${entry.target.id}`) link.setAttribute("aria-current", "true");
          else link.removeAttribute("aria-current");
        }
      }
    },
    { rootMargin: "-30% 0px -65% 0px" },
  );
  document.querySelectorAll("main > section").forEach((section) => observer.observe(section));
})();
