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
    return log ? [Math.log(low), Math.log(high), Math.exp, Math.log] : [+low, +high, value => value, value => value];
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
    const reach = svg === picture ? 9 * view[2] / whole[2] : 9, point = near(points, x, y, reach), lines = [...svg.querySelectorAll("path.line, path.ref")].map(path => [path, height(path, x)]).filter(pair => pair[1] !== null);
    const rows = [], unit = (value, name) => say(value) + (name ? `\u202f${name}` : "");
    if (point) x = point[0];
    if (across) rows.push(make("b", {}, unit(toX(x), unitX)));
    const shown = point ? [[point[2], point[1]]] : lines.slice(0, 8);
    if (up) rows.push(...shown.map(([shape, py]) => make("span", {}, swatch(shape), unit(toY(py), unitY))));
    if (up && !shown.length) rows.push(make("span", {}, unit(toY(Math.max(above, Math.min(y, tall - below))), unitY)));
    svg.querySelectorAll(".hair").forEach(hair => hair.remove());
    const hair = page.createElementNS("http://www.w3.org/2000/svg", "path");
    hair.setAttribute("class", "hair");
    hair.setAttribute("d", `M${x} ${above}V${tall - below}` + (point ? `M${x - reach / 1.5} ${point[1]}h${2 * reach / 1.5}` : ""));
    (svg.querySelector(".drawn") ?? svg).append(hair);
    put(at[0], at[1], ...rows);
  };
  const inside = (svg, event) => new DOMPoint(event.clientX, event.clientY).matrixTransform((svg.querySelector(".drawn") ?? svg).getScreenCTM().inverse());

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

  /* ---- a picture, large: what is drawn zooms, the axes stay beside it with ticks of what is seen */

  let dragged = null;
  const stage = make("div", { className: "stage" }), title = make("p", { className: "what" });
  const control = (text, label, act) => make("button", { type: "button", textContent: text, ariaLabel: label, onclick: act });
  const dialog = make("dialog", { className: "big", ariaLabel: "Picture, enlarged" });
  let picture = null, chart = null, whole = [0, 0, 1, 1], view = whole, cursor = null;
  const vector = (tag, set, text = "") => {
    const made = page.createElementNS("http://www.w3.org/2000/svg", tag);
    Object.entries(set).forEach(([key, value]) => made.setAttribute(key, value));
    made.textContent = text;
    return made;
  };
  const at = (text, key) => +text.getAttribute(key);
  /* a chart in its parts: what is drawn, the ticks and the names beside it, which keep their size, and what stands over it */
  const parted = clone => {
    const [left, right, above, below, width, tall] = clone.dataset.f.split(" ").map(Number);
    const ends = { left, right: width - right, above, foot: tall - below };
    const axes = clone.querySelector(":scope > .axes"), heads = [...clone.querySelectorAll(":scope > .yt")];
    const drawn = vector("g", { class: "drawn" }), names = { x: [], y: [], over: [] }, ticks = { x: [], y: [] };
    for (const text of axes?.querySelectorAll("text") ?? []) {
      const line = text.previousElementSibling, key = line.classList.contains("tk") ? "y" : "x";
      ticks[key].push({ at: at(line, `${key}1`), text: text.textContent });
    }
    axes?.remove();
    heads.forEach(head => head.remove());
    drawn.append(...clone.childNodes);
    for (const text of drawn.querySelectorAll("text")) {
      const [x, y] = [at(text, "x"), at(text, "y")], ofLine = text.previousElementSibling?.tagName === "line";
      const named = { x, y, text: text.textContent, anchor: text.getAttribute("text-anchor") ?? "start" };
      const side = y > ends.foot + 2 ? "x" : x < ends.left || (x > ends.right && named.anchor === "start") ? "y" : y < above && !ofLine ? "over" : "";
      if (!side) continue;
      names[side].push(named);
      text.remove();
    }
    /* an axis of names has no numbers between them */
    for (const key of ["x", "y"]) if (ticks[key].some(tick => !/[\dπ]/.test(tick.text))) {
      names[key].push(...ticks[key].map(tick => key === "x" ? { x: tick.at, y: ends.foot + 14, text: tick.text, anchor: "middle" } : { x: left - 4, y: tick.at + 3.5, text: tick.text, anchor: "end" }));
      ticks[key] = null;
    }
    const units = (clone.dataset.u ?? "|").split("|"), head = foot => heads.find(text => at(text, "y") > above === foot)?.textContent;
    return { ...ends, drawn, names, ticks, up: head(false) ?? units[1], across: head(true) ?? units[0], scales: { x: clone.dataset.x, y: clone.dataset.y } };
  };
  /* (value, label) of at most so many ticks from `low` to `high`: of powers of ten, or of 1, 2, 2.5 and 5 */
  const round = (low, high, most, log) => {
    if (log && high >= 30 * low) {
      const first = Math.ceil(Math.log10(low) - 1e-9), last = Math.floor(Math.log10(high) + 1e-9), every = Math.max(1, Math.ceil((last - first) / most));
      return Array.from({ length: Math.floor((last - first) / every) + 1 }, (_, i) => 10 ** (first + i * every)).map(value => [value, say(value)]);
    }
    const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough)), step = [1, 2, 2.5, 5, 10].map(f => f * power).find(s => s >= rough * 0.999);
    const digits = Math.min(Math.max(-Math.floor(Math.log10(step) + 1e-9) + (Math.abs(step / power - 2.5) < 1e-9 ? 1 : 0), 0), 9), first = Math.ceil(low / step - 1e-9);
    return Array.from({ length: Math.max(Math.floor(high / step + 1e-9) - first + 1, 0) }, (_, i) => (first + i) * step)
      .map(value => [value, value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits }).replace(/^-(?=0[.0]*$)/, "").replace("-", "\u2212")]);
  };
  /* draws the axes of what is seen, in px of the screen */
  const draw = () => {
    const frame = vector("g", { class: "frame" }), add = (...all) => all.map(made => frame.append(made));
    picture.querySelector(".frame")?.remove();
    picture.append(frame);
    const probe = vector("text", {}), long = text => { probe.textContent = text; return probe.getComputedTextLength(); };
    add(probe);
    const { left, right, above, foot, names, ticks, scales } = chart, seen = view[2] < whole[2] * 0.999;
    const room = [stage.clientWidth, Math.max(innerHeight * 0.96 - dialog.firstElementChild.offsetHeight - 70, 200)];
    const lines = text => (text ?? "").split(" ").reduce((all, word) => {
      const longer = `${all.at(-1)} ${word}`.trim();
      return long(longer) <= room[0] - 12 ? [...all.slice(0, -1), longer] : [...all, word];
    }, [""]);
    const span = (key, i) => {
      const [low, high, back] = scale(scales[key]), from = key === "x" ? left : foot, to = key === "x" ? right : above;
      return back(low + (view[+(key === "y")] + i * view[2 + (key === "y")] - from) / (to - from) * (high - low));
    };
    const place = (key, value) => {
      const [low, high, , there] = scale(scales[key]), share = (there(value) - low) / (high - low);
      return key === "x" ? left + share * (right - left) : foot - share * (foot - above);
    };
    const labelled = (key, px) => {
      const own = ticks[key], most = key === "x" ? Math.max(2, Math.floor(px / 80)) : Math.max(2, Math.floor(px / 40));
      if (!own) return [];
      const apart = own.slice(1).map((tick, i) => Math.abs(tick.at - own[i].at) * px / view[key === "x" ? 2 : 3]);
      const fits = apart.every((gap, i) => gap >= (key === "x" ? (long(own[i].text) + long(own[i + 1].text)) / 2 + 4 : 12));
      if (!scales[key] || (!seen && own.length && fits)) return own;
      const ends = [span(key, 0), span(key, 1)].sort((p, q) => p - q);
      /* one tick is no axis */
      const found = [1, 2, 4].map(more => round(...ends, more * most, scales[key].endsWith("log"))).find((all, i) => all.length > 1 || i === 2);
      return found.map(([value, text]) => ({ at: place(key, value), text }));
    };
    const head = lines(chart.up), beside = names.y.filter(name => name.anchor === "end"), after = names.y.filter(name => name.anchor !== "end");
    const most = all => Math.max(0, ...all.map(each => long(each.text)));
    const A = 8 + 16 * head.length + (names.over.length ? 16 : 0), B = 26 + (names.x.length && ticks.x?.length ? 16 : 0) + (chart.across ? 16 : 0), R = Math.max(16, most(after) + 10);
    let L = Math.max(24, most(beside) + 10), by = 1, up = [];
    for (let turn = 0; turn < 2; turn++) {
      by = Math.max(Math.min((room[0] - L - R) / whole[2], (room[1] - A - B) / whole[3]), 0.05);
      up = labelled("y", by * whole[3]);
      L = Math.max(L, most(up) + 10);
    }
    const wide = by * whole[2], tall = by * whole[3], W = L + wide + R, H = A + tall + B, near = by * whole[2] / view[2];
    const px = x => L + (x - view[0]) * near, py = y => A + (y - view[1]) * near;
    const within = (value, low, length) => value >= low - length * 1e-6 && value <= low + length * (1 + 1e-6);
    picture.setAttribute("viewBox", `0 0 ${W} ${H}`);
    picture.style.width = `${W}px`;
    chart.drawn.setAttribute("transform", `matrix(${near} 0 0 ${near} ${px(0)} ${py(0)})`);
    chart.drawn.style.setProperty("--unit", 1 / near);
    stage.style.setProperty("--unit", 1);
    /* whole, what is drawn may reach beyond the axes, as on the page */
    chart.window.setAttribute("clip-path", seen ? "url(#seen)" : "none");
    Object.entries({ x: L, y: A, width: wide, height: tall }).forEach(([key, value]) => chart.hole.setAttribute(key, value));
    const text = (x, y, words, anchor, css = "") => add(vector("text", { x, y, "text-anchor": anchor, class: css }, words));
    for (const tick of up.filter(one => within(one.at, view[1], view[3]))) {
      frame.prepend(vector("line", { class: "tk", x1: L, x2: L + wide, y1: py(tick.at), y2: py(tick.at) }));
      text(L - 6, py(tick.at) + 4.5, tick.text, "end", "ytick");
    }
    for (const tick of labelled("x", wide).filter(one => within(one.at, view[0], view[2]))) {
      const x = px(tick.at), half = long(tick.text) / 2;
      add(vector("line", { class: "ax", x1: x, x2: x, y1: A + tall, y2: A + tall + 4 }));
      text(Math.max(half, Math.min(x, W - half)), A + tall + 18, tick.text, "middle", "xtick");
    }
    add(vector("line", { class: "ax", x1: L, x2: L + wide, y1: A + tall, y2: A + tall }));
    /* names that would lie upon one another come back as the picture grows */
    const lowest = { end: -Infinity, start: -Infinity };
    for (const name of names.y.filter(one => within(one.y, view[1], view[3])).sort((p, q) => p.y - q.y)) {
      const side = name.anchor === "end" ? "end" : "start";
      if (py(name.y) < lowest[side] + 13) continue;
      lowest[side] = py(name.y);
      text(side === "end" ? L - 6 : L + wide + 6, py(name.y), name.text, side);
    }
    let furthest = -Infinity;
    for (const name of names.x.filter(one => within(one.x, view[0], view[2])).sort((p, q) => p.x - q.x)) {
      const length = long(name.text), from = Math.max(0, Math.min(px(name.x) - length * ({ middle: 0.5, end: 1 }[name.anchor] ?? 0), W - length));
      if (from < furthest + 6) continue;
      furthest = from + length;
      text(from, A + tall + (ticks.x?.length ? 34 : 18), name.text, "start");
    }
    names.over.forEach(name => text(L + Math.max(0, Math.min((name.x - left) * by, wide)), A - 5, name.text, name.anchor));
    head.forEach((line, i) => text(0, 13 + 16 * i, line, "start", "yt"));
    if (chart.across) text(L + wide, H - 5, chart.across, "end", "yt");
    probe.remove();
    picture.prepend(frame);
  };
  /* a map has a ruler in place of axes: a round length of what is seen */
  const measure = () => {
    const ruler = picture.querySelector(".ruler"), text = ruler?.nextElementSibling;
    if (!ruler) return;
    const [x, y, length] = ruler.dataset.at.split(" ").map(Number), mm = +ruler.dataset.mm, grown = view[2] / whole[2];
    const most = mm * grown, power = 10 ** Math.floor(Math.log10(most) + 1e-9), now = [5, 2, 1].map(f => f * power).find(f => f <= most * 1.001);
    const from = view[0] + x * grown, down = view[1] + y * grown, to = from + length * now / mm;
    ruler.setAttribute("d", `M${from} ${down}H${to}`);
    text.setAttribute("x", to + 5 * grown);
    text.setAttribute("y", down + 4 * grown);
    text.textContent = `${say(now)} mm`;
  };
  const look = box => {
    view = box;
    picture.dataset.view = box.join(" ");
    if (!dialog.open) return;
    if (chart) { draw(); return; }
    picture.setAttribute("viewBox", box.join(" "));
    measure();
    /* letters shrink with a picture that is wider than the screen, and do not grow beyond their size */
    stage.style.setProperty("--unit", Math.min(box[2] / picture.getBoundingClientRect().width, 1));
  };
  /* px of the screen -> units of the picture; its own, or those of what is drawn in a chart */
  const unit = () => view[2] / (chart ? +chart.hole.getAttribute("width") : picture.getBoundingClientRect().width);
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
    chart = null;
    if (found.tagName === "IMG") {
      const size = [found.naturalWidth || 4, found.naturalHeight || 3];
      picture = vector("svg", {});
      picture.append(vector("image", { href: found.src, width: size[0], height: size[1] }));
      whole = [0, 0, ...size];
    } else {
      picture = found.cloneNode(true);
      picture.querySelectorAll(".hair").forEach(hair => hair.remove());
      whole = found.getAttribute("viewBox").split(" ").map(Number);
      if (picture.dataset.f) {
        chart = parted(picture);
        chart.hole = vector("rect", {});
        chart.window = vector("g", {});
        chart.window.append(chart.drawn);
        const clip = vector("clipPath", { id: "seen" });
        clip.append(chart.hole);
        picture.append(clip, chart.window);
        whole = [chart.left, chart.above, chart.right - chart.left, chart.foot - chart.above];
      }
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
  addEventListener("resize", () => dialog.open && look(view));
  stage.addEventListener("wheel", event => {
    event.preventDefault();
    const { x, y } = inside(picture, event);
    zoom(event.deltaY < 0 ? 1.2 : 1 / 1.2, x, y);
  }, { passive: false });
  stage.addEventListener("pointerdown", event => { dragged = [event.clientX, event.clientY, view]; stage.setPointerCapture(event.pointerId); hide(); });
  stage.addEventListener("pointermove", event => {
    if (!dragged) return;
    const [x, y, from] = dragged, by = unit();
    look([0, 1].map(i => Math.max(whole[i], Math.min(from[i] - by * ([event.clientX, event.clientY][i] - [x, y][i]), whole[i] + whole[i + 2] - from[i + 2]))).concat(from.slice(2)));
  });
  for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, () => { dragged = null; });
  dialog.addEventListener("click", event => event.target === dialog && dialog.close());
  dialog.addEventListener("close", hide);
  dialog.addEventListener("keydown", event => {
    if (event.key === "+" || event.key === "=") zoom(1.5);
    if (event.key === "-") zoom(1 / 1.5);
    if (event.key === "0") look(whole);
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step || !chart) return;
    event.preventDefault();
    cursor = Math.max(view[0], Math.min(cursor + step * view[2] / 100, view[0] + view[2]));
    const at = new DOMPoint(cursor, view[1] + view[3] / 3).matrixTransform(chart.drawn.getScreenCTM());
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

  /* ---- a second level of detail opens where a link leads to its heading, and for print */

  const unfold = () => {
    const found = location.hash && page.getElementById(decodeURIComponent(location.hash.slice(1)))?.closest("summary");
    if (found) found.parentElement.open = true;
  };
  unfold();
  addEventListener("hashchange", unfold);
  addEventListener("beforeprint", () => page.querySelectorAll("details.more").forEach(more => { more.open = true; }));

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
