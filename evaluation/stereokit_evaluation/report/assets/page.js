// What every page has: the theme, tables that sort, and the start of the viewer.
"use strict";

const Page = (() => {
  const listeners = [];
  const dark = () => (document.documentElement.dataset.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
  const changed = () => listeners.forEach((tell) => tell(dark()));

  function theme() {
    const button = document.getElementById("theme");
    const say = () => button.setAttribute("aria-label", dark() ? "Switch to the light theme" : "Switch to the dark theme");
    button.addEventListener("click", () => {
      document.documentElement.dataset.theme = dark() ? "light" : "dark";
      say();
      changed();
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { say(); changed(); });
    say();
  }

  // A click sorts ascending, the next descending; cells without a figure stay last.
  function sorting() {
    for (const head of document.querySelectorAll("table.sortable thead th")) {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => {
        const table = head.closest("table");
        const column = [...head.parentNode.children].indexOf(head);
        const down = head.getAttribute("aria-sort") === "ascending";
        table.querySelectorAll("th[aria-sort]").forEach((th) => th.removeAttribute("aria-sort"));
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        const value = (row) => row.children[column].textContent.trim();
        const rows = [...table.tBodies[0].rows];
        rows.sort((p, q) => {
          const [s, t] = [value(p), value(q)];
          const [m, n] = [Number.parseFloat(s), Number.parseFloat(t)];
          if (s === "–" || t === "–") return (s === "–") - (t === "–");
          const order = Number.isNaN(m) || Number.isNaN(n) ? s.localeCompare(t) : m - n;
          return down ? -order : order;
        });
        table.tBodies[0].append(...rows);
      });
    }
  }

  // The viewer reads its first pair when it comes near.
  function startViewer() {
    const viewer = document.getElementById("viewer");
    if (!viewer) return;
    const watch = new IntersectionObserver((entries) => {
      if (!entries.some((entry) => entry.isIntersecting)) return;
      watch.disconnect();
      Viewer.start();
    }, { rootMargin: "300px" });
    watch.observe(viewer);
  }

  function start() {
    theme();
    sorting();
    Pairs.start();
    startViewer();
  }

  return { start, dark, onTheme: (tell) => listeners.push(tell) };
})();

document.addEventListener("DOMContentLoaded", Page.start);
