"use strict";

// The theme, chosen before anything is drawn: the system's until the reader chooses.
const theme = (() => {
  const order = ["auto", "light", "dark"];
  const system = matchMedia("(prefers-color-scheme: dark)");
  let choice = "auto";
  let listener = () => {};
  let onPaper = false;
  try {
    choice = localStorage.getItem("theme") ?? "auto";
  } catch {
    // A browser may refuse storage to pages from files.
  }

  const apply = () => {
    const dark = !onPaper && (choice === "auto" ? system.matches : choice === "dark");
    document.documentElement.dataset.theme = dark ? "dark" : "light";
    listener();
  };
  system.addEventListener("change", apply);
  apply();

  return {
    get choice() {
      return choice;
    },
    next() {
      choice = order[(order.indexOf(choice) + 1) % order.length];
      try {
        localStorage.setItem("theme", choice);
      } catch {
        // As above.
      }
      apply();
    },
    // Paper is white.
    forPaper(isPaper) {
      onPaper = isPaper;
      apply();
    },
    onChange(call) {
      listener = call;
    },
  };
})();
