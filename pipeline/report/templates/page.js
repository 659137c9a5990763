"use strict";
/* What a page does beyond lying there: tables sort, pictures enlarge and tell their values, words explain themselves.
   Nothing is stored, nothing is fetched but machine.js, and nothing on the page needs it. */
(() => {
  const page = document, make = (tag, set = {}, ...inside) => {
    const made = Object.assign(page.createElement(tag), set);
    made.append(...inside);
    return made;
  };

  /* ---- tables */

  const SUPER = "⁰¹²³⁴⁵⁶⁷⁸⁹";
  /* a cell as the number that it begins with, or as its text; data-v comes first */
  const number = cell => {
    const text = (cell?.dataset.v ?? cell?.textContent ?? "").replace(/[\u202f\u00a0]/g, " ").replace(/\u2212/g, "-").replace(/(\d),(?=\d{3})/g, "$1").trim();
    if (/^never/.test(text)) return Infinity;
    const found = text.match(/^[±≤≥γ=\s]*([+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?)(?: × 10(⁻?)([⁰¹²³⁴⁵⁶⁷⁸⁹]+))?/);
    if (!found) return NaN;
    const power = found[3] ? [...found[3]].reduce((sum, digit) => 10 * sum + SUPER.indexOf(digit), 0) : 0;
    return found[1] * 10 ** (found[2] ? -power : power);
  };
  const sortable = table => {
    const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells], rows = [...body.rows];
    if (rows.length < 2) return;
    heads.forEach((head, column) => {
      const cells = rows.map(row => row.cells[column]), numbers = cells.map(number);
      const numeric = head.classList.contains("num") ? numbers.some(n => !isNaN(n)) : numbers.every(n => !isNaN(n));
      const button = make("button", { type: "button", className: "sortby" }, ...head.childNodes);
      head.append(button);
      (button.querySelector("small") ?? button).append(make("span", { className: "way", ariaHidden: "true" }));
      button.onclick = () => {
        /* up, down, and back to the order of the page */
        const next = { ascending: "descending", descending: "" }[head.getAttribute("aria-sort")] ?? "ascending", sign = next === "descending" ? -1 : 1;
        heads.forEach(other => other.removeAttribute("aria-sort"));
        if (next) head.setAttribute("aria-sort", next);
        const order = rows.map((_, i) => i);
        if (next) order.sort((a, b) => {
          const [one, two] = numeric ? [numbers[a], numbers[b]] : [cells[a], cells[b]].map(cell => cell?.textContent.trim() ?? "");
          if (!numeric) return sign * one.localeCompare(two, "en", { numeric: true }) || a - b;
          /* what has no value stands last in both directions */
          return isNaN(one) - isNaN(two) || (one === two || isNaN(one) ? a - b : sign * (one < two ? -1 : 1));
        });
        body.append(...order.map(i => rows[i]));
      };
    });
  };
  page.querySelectorAll("table.sort").forEach(sortable);

  /* ---- the tip: values of a picture, the meaning of a word */

  const tip = make("div", { className: "tip", hidden: true });
  (page.querySelector("main") ?? page.body).append(tip);
  const put = (x, y, ...inside) => {
    const home = page.querySelector("dialog[open]") ?? page.querySelector("main");
    if (tip.parentNode !== home) home.append(tip);
    tip.replaceChildren(...inside);
    tip.hidden = false;
    const box = tip.getBoundingClientRect(), wide = page.documentElement.clientWidth;
    tip.style.left = `${Math.max(4, Math.min(x + 14, wide - box.width - 8))}px`;
    tip.style.top = `${y + 18 + box.height > innerHeight ? Math.max(y - box.height - 12, 4) : y + 18}px`;
  };
  const hide = () => {
    if (tip.hidden) return;
    tip.hidden = true;
    page.querySelectorAll("svg .hair").forEach(hair => hair.remove());
  };

  const scale = text => {
    const [low, high, log] = text.split(" ");
    return log ? [Math.log(low), Math.log(high), Math.exp] : [+low, +high, value => value];
  };
  const say = value => value === 0 ? "0" : Math.abs(value) >= 1e6 || Math.abs(value) < 1e-4 ? value.toExponential(2) : (+value.toPrecision(Math.abs(value) >= 1000 ? 4 : 3)).toLocaleString("en", { maximumFractionDigits: 9 }).replace("-", "\u2212");
  /* corners of a path of M, L, H and V, in the picture's own units; null starts a new piece */
  const corners = path => {
    if (path.corners) return path.corners;
    const found = [];
    let x = 0, y = 0;
    for (const [, pen, rest] of path.getAttribute("d").matchAll(/([MLHV])([^A-Za-z]*)/g)) {
      const [a, b] = rest.trim().split(/[\s,]+/).map(Number);
      if (pen === "M") found.push(null);
      [x, y] = pen === "H" ? [a, y] : pen === "V" ? [x, a] : [a, b];
      found.push([x, y]);
    }
    return (path.corners = found);
  };
  const height = (path, x) => {
    const found = corners(path);
    for (let i = 1; i < found.length; i++) {
      const [a, b] = [found[i - 1], found[i]];
      if (a && b && a[0] <= x && x <= b[0]) return a[0] === b[0] ? b[1] : a[1] + (b[1] - a[1]) * (x - a[0]) / (b[0] - a[0]);
    }
    return null;
  };
  const near = (points, x, y, reach) => points.map(p => [Math.hypot(p[0] - x, p[1] - y), p]).sort((a, b) => a[0] - b[0]).find(p => p[0] <= reach)?.[1];
  const swatch = shape => {
    const style = getComputedStyle(shape), dashed = style.strokeDasharray !== "none", dot = shape.tagName === "circle";
    const made = make("i", { className: dot ? "dot" : "" });
    made.style.borderTop = `${dashed ? "dashed" : "solid"} ${parseFloat(style.strokeWidth) > 1.2 ? 3 : 2}px ${dot && style.fill !== "none" ? style.fill : style.stroke}`;
    return made;
  };

  const tell = (svg, x, y, at) => {
    const [left, right, above, below, width, tall] = svg.dataset.f.split(" ").map(Number);
    const across = svg.dataset.x && scale(svg.dataset.x), up = svg.dataset.y && scale(svg.dataset.y), [unitX, unitY] = (svg.dataset.u ?? "|").split("|");
    x = Math.max(left, Math.min(x, width - right));
    /* a line of few corners has no value between them: the nearest one is told */
    const few = svg.querySelector("path.line"), stops = few ? corners(few).filter(Boolean) : [];
    if (stops.length && stops.length <= 40) x = stops.reduce((best, stop) => Math.abs(stop[0] - x) < Math.abs(best - x) ? stop[0] : best, stops[0][0]);
    const toX = px => across[2](across[0] + (px - left) / (width - left - right) * (across[1] - across[0]));
    const toY = py => up[2](up[0] + (tall - below - py) / (tall - above - below) * (up[1] - up[0]));
    const points = [...svg.querySelectorAll("circle:not(.hair)")].map(c => [+c.getAttribute("cx"), +c.getAttribute("cy"), c]);
    points.push(...[...svg.querySelectorAll("path.stem")].flatMap(path => corners(path).filter((p, i, all) => p && all[i - 1]).map(p => [p[0], p[1], path])));
    const point = near(points, x, y, 9), lines = [...svg.querySelectorAll("path.line, path.ref")].map(path => [path, height(path, x)]).filter(pair => pair[1] !== null);
    const rows = [], unit = (value, name) => say(value) + (name ? `\u202f${name}` : "");
    if (point) x = point[0];
    if (across) rows.push(make("b", {}, unit(toX(x), unitX)));
    const shown = point ? [[point[2], point[1]]] : lines.slice(0, 8);
    if (up) rows.push(...shown.map(([shape, py]) => make("span", {}, swatch(shape), unit(toY(py), unitY))));
    if (up && !shown.length) rows.push(make("span", {}, unit(toY(Math.max(above, Math.min(y, tall - below))), unitY)));
    svg.querySelectorAll(".hair").forEach(hair => hair.remove());
    const hair = page.createElementNS("http://www.w3.org/2000/svg", "path");
    hair.setAttribute("class", "hair");
    hair.setAttribute("d", `M${x} ${above}V${tall - below}` + (point ? `M${x - 6} ${point[1]}h12` : ""));
    svg.append(hair);
    put(at[0], at[1], ...rows);
  };
  const inside = (svg, event) => new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());

  /* the meaning of a word, or what a strip says */
  const explain = target => {
    const word = target.closest("a.term"), strip = target.closest(".strip > svg");
    const text = word ? page.getElementById(word.hash.slice(1))?.querySelector("dd")?.textContent : strip?.getAttribute("aria-label");
    if (!text) return false;
    const box = (word ?? strip).getBoundingClientRect();
    tip.className = "tip said";
    put(box.left - 14, box.bottom - 12, text);
    return true;
  };
  page.addEventListener("pointermove", event => {
    const svg = event.target.closest?.("svg[data-f]");
    if (!svg || dragged) { if (!event.target.closest?.("a.term, .strip > svg")) hide(); return; }
    page.querySelectorAll("svg .hair").forEach(hair => hair.ownerSVGElement !== svg && hair.remove());
    const { x, y } = inside(svg, event);
    tip.className = "tip";
    tell(svg, x, y, [event.clientX, event.clientY]);
  });
  page.addEventListener("pointerover", event => event.target.closest && explain(event.target));
  page.addEventListener("focusin", event => explain(event.target));
  page.addEventListener("focusout", hide);
  page.addEventListener("scroll", hide, true);
  page.addEventListener("keydown", event => event.key === "Escape" && hide());
  page.documentElement.addEventListener("pointerleave", hide);

  /* ---- a picture, large */

  let dragged = null;
  const stage = make("div", { className: "stage" }), title = make("p", { className: "what" });
  const control = (text, label, act) => make("button", { type: "button", textContent: text, ariaLabel: label, onclick: act });
  const dialog = make("dialog", { className: "big", ariaLabel: "Picture, enlarged" });
  let picture = null, whole = [0, 0, 1, 1], view = whole, cursor = null;
  /* letters and dots keep their size on the screen, whatever the zoom */
  const look = box => {
    view = box;
    picture.setAttribute("viewBox", box.join(" "));
    if (dialog.open) stage.style.setProperty("--unit", box[2] / picture.getBoundingClientRect().width);
  };
  const zoom = (factor, x = view[0] + view[2] / 2, y = view[1] + view[3] / 2) => {
    const grown = Math.min(Math.max(view[2] / factor, whole[2] / 40), whole[2]) / view[2];
    const size = [view[2] * grown, view[3] * grown];
    look([0, 1].map(i => Math.max(whole[i], Math.min([x, y][i] - ([x, y][i] - view[i]) * grown, whole[i] + whole[i + 2] - size[i]))).concat(size));
  };
  dialog.append(
    make("div", { className: "bar" }, title, control("−", "Zoom out", () => zoom(1 / 1.5)), control("+", "Zoom in", () => zoom(1.5)),
      control("1:1", "Whole picture", () => look(whole)), control("Close", "Close", () => dialog.close())),
    stage,
  );
  page.body.append(dialog);
  const enlarge = found => {
    if (found.tagName === "IMG") {
      picture = page.createElementNS("http://www.w3.org/2000/svg", "svg");
      const image = page.createElementNS("http://www.w3.org/2000/svg", "image"), size = [found.naturalWidth || 4, found.naturalHeight || 3];
      image.setAttribute("href", found.src);
      ["width", "height"].forEach((key, i) => image.setAttribute(key, size[i]));
      picture.append(image);
      whole = [0, 0, ...size];
    } else {
      picture = found.cloneNode(true);
      picture.querySelectorAll(".hair").forEach(hair => hair.remove());
      whole = found.getAttribute("viewBox").split(" ").map(Number);
    }
    title.textContent = found.alt ?? found.getAttribute("aria-label");
    picture.setAttribute("role", "img");
    picture.setAttribute("aria-label", title.textContent);
    picture.setAttribute("tabindex", "0");
    stage.style.setProperty("--shape", whole[2] / whole[3]);
    stage.replaceChildren(picture);
    hide();
    dialog.showModal();
    look(whole);
    cursor = whole[0] + whole[2] / 2;
  };
  stage.addEventListener("wheel", event => {
    event.preventDefault();
    const { x, y } = inside(picture, event);
    zoom(event.deltaY < 0 ? 1.2 : 1 / 1.2, x, y);
  }, { passive: false });
  stage.addEventListener("pointerdown", event => { dragged = [event.clientX, event.clientY, view]; stage.setPointerCapture(event.pointerId); hide(); });
  stage.addEventListener("pointermove", event => {
    if (!dragged) return;
    const [x, y, from] = dragged, unit = from[2] / picture.getBoundingClientRect().width;
    look([0, 1].map(i => Math.max(whole[i], Math.min(from[i] - unit * ([event.clientX, event.clientY][i] - [x, y][i]), whole[i] + whole[i + 2] - from[i + 2]))).concat(from.slice(2)));
  });
  for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, () => { dragged = null; });
  dialog.addEventListener("click", event => event.target === dialog && dialog.close());
  dialog.addEventListener("close", hide);
  dialog.addEventListener("keydown", event => {
    if (event.key === "+" || event.key === "=") zoom(1.5);
    if (event.key === "-") zoom(1 / 1.5);
    if (event.key === "0") look(whole);
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step || !picture.dataset.f) return;
    event.preventDefault();
    cursor = Math.max(view[0], Math.min(cursor + step * view[2] / 100, view[0] + view[2]));
    const at = new DOMPoint(cursor, view[1] + view[3] / 3).matrixTransform(picture.getScreenCTM());
    tip.className = "tip";
    tell(picture, cursor, -99, [at.x, at.y]);
  });
  page.querySelectorAll("figure").forEach(figure => {
    const found = figure.querySelector("svg.plot, img");
    if (!found) return;
    const button = control("", `Enlarge: ${found.alt ?? found.getAttribute("aria-label")}`, () => enlarge(found));
    button.className = "zoom";
    button.title = "Enlarge";
    found.after(button);
    found.addEventListener("click", () => enlarge(found));
  });

  /* ---- what the run was made on: beside the pages, not in them, so that they are the same on every machine */

  const told = () => {
    const now = window.beadline?.machine;
    if (!now) return;
    const day = new Date(now.date).toLocaleDateString("en-GB", { day: "numeric", month: "short", year: "numeric", timeZone: "UTC" });
    const commit = now.commit === "none" ? "no commit" : `commit ${now.commit}${now.changed ? " with uncommitted changes" : ""}`;
    const first = page.querySelector("[data-run]");
    if (first) first.textContent = `beadline ${now.version}, ${commit}, ${now.cpu}, pins ${now.pins}, ${day}.`;
    else page.querySelector("main").after(make("footer", { className: "wrap made" }, `Last run on ${now.cpu}, pins ${now.pins}, beadline ${now.version}, ${commit}, ${day}`));
    page.querySelectorAll("[data-made]").forEach(cell => { cell.textContent = day; });
    page.querySelectorAll("[data-run-column]").forEach(cell => { cell.hidden = false; });
    /* the page carries the accepted run's machine only where inputs, parameters and code are the same */
    const place = page.querySelector("[data-machine]"), then = place && JSON.parse(place.dataset.machine);
    if (!then || then.locked !== now.locked) return;
    const cpu = then.cpu !== now.cpu, pins = then.pins !== now.pins;
    if (!cpu && !pins) return;
    const name = machine => [cpu && machine.cpu, pins && `pins ${machine.pins}`].filter(Boolean).join(", ");
    const what = cpu && pins ? "CPU and pins differ" : cpu ? "the CPU differs" : "the pins differ";
    place.append(make("strong", {}, `Nothing but ${what} from the accepted run: ${name(then)} then, ${name(now)} now.`));
    place.hidden = false;
    page.querySelectorAll("[data-alone]").forEach(text => { text.textContent = text.dataset.alone; });
  };
  // a page without others beside it has no machine.js either
  if (page.querySelector(".mast nav")) page.head.append(make("script", { src: "machine.js", onload: told }));
  page.documentElement.classList.add("js");
})();
