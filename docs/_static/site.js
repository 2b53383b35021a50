// Mends for readers by ear or keyboard: levels of headings, names of landmarks, and scrolled blocks.
document.addEventListener("DOMContentLoaded", () => {
  const all = (selector, mend) => document.querySelectorAll(selector).forEach(mend);
  all(".caption[role=heading]", (caption) => caption.setAttribute("aria-level", "2"));
  all(".sidebar-drawer", (drawer) => drawer.setAttribute("aria-label", "Pages"));
  all(".toc-drawer", (drawer) => drawer.setAttribute("aria-label", "On this page"));
  all("pre, article table.docutils", (block) => {
    if (block.scrollWidth > block.clientWidth) block.tabIndex = 0;
  });
  all("th", (head) => {
    if (!head.textContent.trim()) head.replaceWith(document.createElement("td"));
  });
});
