"use strict";
/* The viewer. State lives in the address; columns are loaded as scripts, for a page cannot read the file beside it from
   file://. uPlot has the axes, the cursor and the dragging; the lines are drawn here, every sample counted: where a pixel
   column holds many of them, from its lowest to its highest. */
(() => {
  const page = document, root = page.getElementById("viewer");
  const { tables, start } = JSON.parse(page.getElementById("series").textContent);
  if (!tables.length) return;
  const make = (tag, set = {}, ...inside) => { const made = Object.assign(page.createElement(tag), set); made.append(...inside); return made; };
  const MOST = 40, KEYS = "Arrow keys move the cursor, with Shift the view; plus and minus zoom, 0 shows all.";

  /* ---- columns: base64 -> float32, each file once */

  const columns = {}, waiting = {};
  const bytes = text => {
    if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text).buffer;
    const raw = atob(text), made = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) made[i] = raw.charCodeAt(i);
    return made.buffer;
  };
  window.beadlineSeries = (name, size, at, text) => { columns[name] = { at, values: size === 8 ? new Float64Array(bytes(text)) : new Float32Array(bytes(text)) }; };
  const load = file => waiting[file] ??= new Promise((done, failed) => page.head.append(make("script", {
    src: `data/${file}.js`, onload: () => done(),
    onerror: () => { delete waiting[file]; failed(new Error(`data/${file}.js cannot be read. It belongs beside this page: copy the folder "data" with it, or run ./run dvc repro report.`)); },
  })));

  /* ---- the state and its address */

  const byName = Object.fromEntries(tables.map(table => [table.name, table]));
  const all = table => table.books.flatMap((book, b) => book.runs.map((run, r) => ({ book, r, codes: run[0], n: run[1], x0: run[2], dx: run[3], table })));
  const mains = table => table.lines.filter(line => !line.beside);
  let state = null;
  /* what is asked for, completed: of keys that are not named the first run's value, or all that go with the others */
  const complete = asked => {
    const complaints = [], table = byName[asked.t] ?? tables[0];
    if (asked.t && !byName[asked.t]) complaints.push(`This run has no series "${asked.t}".`);
    const known = (name, have, asks) => asks.filter(value => have.includes(value) || (complaints.push(`"${value}" is not among ${name}.`), false));
    let left = all(table);
    const keys = {}, narrow = (k, codes) => { const next = left.filter(run => codes.includes(run.codes[k])); keys[table.keys[k].name] = codes.map(code => table.keys[k].values[code]); if (next.length) left = next; };
    const told = table.keys.map(key => known(key.label, key.values, asked[key.name] ?? []));
    told.forEach((values, k) => values.length && narrow(k, values.map(value => table.keys[k].values.indexOf(value))));
    table.keys.forEach((key, k) => { if (!told[k].length && left.length) narrow(k, key.one ? [left[0].codes[k]] : [...new Set(left.map(run => run.codes[k]))].slice(0, 4)); });
    const names = mains(table).map(line => line.name), y = known("the lines", names, asked.y ?? []);
    const range = (asked.x ?? []).map(Number);
    return {
      complaints, t: table.name, keys, y: y.length ? y : mains(table).filter(line => line.panel === table.lines[0].panel).map(line => line.name),
      x: range.length === 2 && range[0] < range[1] ? range : null, p: asked.p?.[0] === "unit" ? "unit" : "signal",
      diff: asked.diff?.length === 2 ? asked.diff : null, c: asked.c && isFinite(asked.c[0]) ? +asked.c[0] : null,
    };
  };
  const read = () => {
    const params = new URLSearchParams(location.hash.slice(1)), asked = {};
    for (const key of params.keys()) asked[key] = params.getAll(key);
    if (!asked.t) return { ...start, ...asked };
    const told = Object.keys(asked).length > 1 || asked.t[0] !== start.t ? {} : start;
    return { ...told, ...asked, t: asked.t[0], ...(asked.x ? { x: asked.x[0].split(",") } : {}) };
  };
  const address = () => {
    const params = new URLSearchParams([["t", state.t]]);
    for (const [key, values] of Object.entries(state.keys)) values.forEach(value => params.append(key, value));
    state.y.forEach(name => params.append("y", name));
    if (state.p === "unit") params.set("p", "unit");
    if (state.x) params.set("x", state.x.map(v => +v.toPrecision(12)).join(","));
    (state.diff ?? []).forEach(id => params.append("diff", id));
    if (state.c !== null) params.set("c", +state.c.toPrecision(12));
    return "#" + params.toString().replace(/\+/g, "%20").replace(/%2C/g, ",").replace(/%7C/g, "|");
  };
  let later = 0, written = "";
  const write = () => { clearTimeout(later); later = setTimeout(() => { written = address(); if (location.hash !== written) history.replaceState(null, "", written); }, 120); };

  /* ---- lines: samples of one run of one column */

  const position = (line, value) => {
    /* the first sample at or after a value */
    if (line.dx) return Math.max(0, Math.min(line.n, Math.ceil((value - line.x0) / line.dx - 1e-9)));
    let low = 0, high = line.n;
    while (low < high) { const mid = (low + high) >> 1; if (line.xs[mid] < value) low = mid + 1; else high = mid; }
    return low;
  };
  const at = (line, k) => line.dx ? line.x0 + line.dx * k : line.xs[k];
  const nearest = (line, value) => {
    const k = position(line, value);
    if (line.steps) return k < line.n && at(line, k) === value ? k : Math.max(k - 1, 0);
    return k > 0 && (k === line.n || value - at(line, k - 1) <= at(line, k) - value) ? k - 1 : Math.min(k, line.n - 1);
  };
  const chosen = () => {
    const table = byName[state.t], codes = table.keys.map(key => state.keys[key.name].map(value => key.values.indexOf(value)));
    return all(table).filter(run => run.codes.every((code, k) => codes[k].includes(code)));
  };
  const wanted = () => {
    const table = byName[state.t], vary = table.keys.map(key => state.keys[key.name].length > 1), found = [];
    for (const [i, line] of table.lines.entries()) {
      if (!state.y.includes(line.beside || line.name)) continue;
      for (const run of chosen()) found.push({ i, line, run, label: table.keys.map((key, k) => vary[k] || (key.name === table.who && key.values.length > 1 && !line.beside) ? key.words[run.codes[k]] : "").filter(Boolean).join(", ") });
    }
    return found;
  };
  const owner = run => {
    const place = run.table.keys.findIndex(key => key.name === run.table.who), value = place < 0 ? "" : run.table.keys[place].values[run.codes[place]];
    return { owner: value, who: run.table.marks[value] ?? "" };
  };
  const fetched = async list => {
    const files = new Set(list.flatMap(({ i, run }) => run.book.together ? [run.book.name] : [`${run.book.name}.${i}`, ...(run.dx ? [] : [`${run.book.name}.x`])]));
    await Promise.all([...files].map(load));
    const lines = [];
    for (const { i, line, run, label } of list) {
      const { at: begin, values } = columns[`${run.book.name}.${i}`], offset = begin[run.r];
      const xs = run.dx ? null : columns[`${run.book.name}.x`];
      const made = {
        id: [line.name, ...run.codes.map((code, k) => run.table.keys[k].values[code])].join("|"), name: line.label + (label ? `, ${label}` : ""),
        unit: line.unit, raw: line.raw, panel: line.panel, column: line.name, steps: line.steps, beside: line.beside, run, n: run.n, x0: run.x0, dx: run.dx,
        xs: xs && xs.values.subarray(xs.at[run.r], xs.at[run.r] + run.n), y: values.subarray(offset, offset + run.n), ...owner(run), label,
      };
      /* a reference is one line, whoever follows it */
      const others = line.beside ? lines.filter(other => other.column === line.name) : [];
      if (others.some(other => together(other, made) && other.y.every((v, k) => v === made.y[k] || v !== v))) continue;
      if (line.beside && !others.length) made.name = line.label;
      lines.push(made);
    }
    return lines;
  };
  /* sampled at the same times */
  const together = (a, b) => a.n === b.n && a.x0 === b.x0 && a.dx === b.dx && (a.dx || a.xs.every((v, k) => v === b.xs[k]));
  /* A - B at A's times; B is held or joined linearly where it has no sample there */
  const difference = lines => {
    if (!state.diff) return null;
    const [a, b] = state.diff.map(id => lines.find(line => line.id === id));
    if (!a || !b) return null;
    if (a.raw !== b.raw) { tell(`A difference needs one unit: ${a.name} is in ${a.unit || "no unit"}, ${b.name} in ${b.unit || "no unit"}.`); return null; }
    const same = together(a, b);
    const y = new Float32Array(a.n);
    for (let k = 0; k < a.n; k++) {
      if (same) { y[k] = a.y[k] - b.y[k]; continue; }
      const x = at(a, k), right = position(b, x);
      if (right < b.n && at(b, right) === x) y[k] = a.y[k] - b.y[right];
      else if (right === 0 || right === b.n) y[k] = NaN;
      else if (b.steps) y[k] = a.y[k] - b.y[right - 1];
      else { const [p, q] = [at(b, right - 1), at(b, right)]; y[k] = a.y[k] - (b.y[right - 1] + (b.y[right] - b.y[right - 1]) * (x - p) / (q - p)); }
    }
    const how = same ? "" : b.steps ? " (second one held between its samples)" : " (second one joined linearly between its samples)";
    return { ...a, id: "difference", y, name: `(${a.name}) − (${b.name})${how}`, panel: "difference", column: "difference", beside: "", who: "", owner: "", label: "" };
  };

  /* ---- how a line looks: colour by whose it is; each has dashes of its own and a number, for print and grey screens */

  const DASHES = [[], [7, 3], [10, 3, 2, 3], [14, 4], [5, 2, 1, 2], [2, 3]];
  const colour = name => getComputedStyle(page.documentElement).getPropertyValue(`--${name}`).trim();
  const dress = lines => {
    const free = ["ink", "over2", "lack2", "muted"], mine = lines.filter(line => !line.beside);
    /* where one controller has several quantities in a picture, colours tell these apart */
    const whose = new Set(mine.map(line => line.owner)).size > 1 || new Set(mine.map(line => line.column)).size === 1;
    for (const line of lines) {
      if (line.beside) { Object.assign(line, { ink: "muted", dash: [3, 3], wide: 1.2 }); continue; }
      const place = mine.indexOf(line);
      line.ink = !whose || !line.who ? free[place % free.length] : { dd: "blue", bl: "grey" }[line.who] ?? "ink";
      line.dash = DASHES[place % DASHES.length];
      line.wide = 1.6;
    }
  };
  const say = value => value === undefined || isNaN(value) ? "missing" : (value === 0 ? "0" : Math.abs(value) >= 1e7 || Math.abs(value) < 1e-4 ? value.toExponential(4) : (+value.toPrecision(6)).toLocaleString("en", { maximumFractionDigits: 9 })).replace("-", "\u2212");
  const withUnit = (value, unit) => say(value) + (unit && !isNaN(value) ? `\u202f${unit}` : "");

  /* ---- drawing */

  const extent = (lines, low, high) => {
    let least = Infinity, most = -Infinity;
    for (const line of lines) {
      const first = Math.max(position(line, low) - 1, 0), last = Math.min(position(line, high) + 1, line.n), y = line.y;
      for (let k = first; k < last; k++) { const v = y[k]; if (v < least && v !== -Infinity) least = v; if (v > most && v !== Infinity) most = v; }
    }
    if (least > most) return [0, 1];
    const room = 0.05 * (most - least) || Math.abs(most) * 0.05 || 1;
    return [least - room, most + room];
  };
  const trace = (ctx, path, dots, line, box, x, y, ratio) => {
    const first = Math.max(position(line, x.min) - 1, 0), last = Math.min(position(line, x.max) + 1, line.n), values = line.y;
    const acrossX = box.width / (x.max - x.min), upY = box.height / (y.max - y.min), px = v => box.left + (v - x.min) * acrossX, py = v => box.top + box.height - (v - y.min) * upY;
    let pen = false;
    if (last - first <= 3 * box.width) {
      for (let k = first; k < last; k++) {
        const v = values[k];
        if (!isFinite(v)) { pen = false; continue; }
        const a = px(at(line, k)), b = py(v);
        if (!pen) { path.moveTo(a, b); if (k + 1 === last || !isFinite(values[k + 1])) path.lineTo(a + 0.01, b); }
        else { if (line.steps) path.lineTo(a, py(values[k - 1])); path.lineTo(a, b); }
        pen = true;
      }
      if (last - first <= box.width / (12 * ratio) && !line.steps && !line.beside) for (let k = first; k < last; k++) if (isFinite(values[k])) { const a = px(at(line, k)), b = py(values[k]), r = 2.4 * ratio; dots.moveTo(a + r, b); dots.arc(a, b, r, 0, 7); }
      return;
    }
    /* a bar from the lowest to the highest of each column, and to where the column before ended */
    const wide = Math.round(box.width), step = (x.max - x.min) / wide, thick = Math.max(1, Math.round(line.wide * ratio));
    let k = first, before = NaN;
    for (let column = -1; column <= wide && k < last; column++) {
      const end = column === wide ? last : Math.min(position(line, x.min + (column + 1) * step), last);
      let tail = NaN, least = Infinity, most = -Infinity, gone = false;
      for (; k < end; k++) {
        const v = values[k];
        if (!isFinite(v)) { gone = true; continue; }
        tail = v;
        if (v < least) least = v;
        if (v > most) most = v;
      }
      if (tail !== tail) { if (gone) before = NaN; continue; }
      if (before < least) least = before; else if (before > most) most = before;
      const top = py(most);
      ctx.fillRect(Math.round(box.left) + column, top - thick / 2, thick, py(least) - top + thick);
      before = tail;
    }
  };
  const paint = (u, panel) => {
    const { ctx, bbox: box } = u, ratio = uPlot.pxRatio, x = u.scales.x, y = u.scales.y, ends = [];
    ctx.save();
    ctx.beginPath();
    ctx.rect(box.left, box.top, box.width, box.height);
    ctx.clip();
    for (const line of panel.lines) {
      const path = new Path2D(), dots = new Path2D();
      ctx.strokeStyle = ctx.fillStyle = colour(line.ink);
      ctx.globalAlpha = hot && hot !== line ? 0.2 : 1;
      trace(ctx, path, dots, line, box, x, y, ratio);
      ctx.lineWidth = line.wide * ratio * (hot === line ? 1.6 : 1);
      ctx.setLineDash(line.dash.map(d => d * ratio));
      ctx.lineJoin = "bevel";
      ctx.stroke(path);
      ctx.fill(dots);
      for (let k = Math.min(position(line, x.max), line.n - 1); k >= 0 && at(line, k) >= x.min; k--) if (at(line, k) <= x.max && isFinite(line.y[k])) { ends.push([u.valToPos(line.y[k], "y", true), line, u.valToPos(at(line, k), "x", true)]); break; }
    }
    ctx.restore();
    /* numbers at the ends of lines, apart from one another */
    ctx.save();
    ctx.font = `600 ${12 * ratio}px system-ui, sans-serif`;
    ctx.textBaseline = "middle";
    ctx.textAlign = "left";
    const gap = 13 * ratio, top = box.top + gap / 2, bottom = box.top + box.height;
    ends.sort((a, b) => a[0] - b[0]);
    ends.forEach((end, i) => { end[0] = Math.max(end[0], i ? ends[i - 1][0] + gap : top); });
    for (let i = ends.length - 1, limit = bottom; i >= 0; i--, limit = ends[i + 1][0] - gap) ends[i][0] = Math.min(ends[i][0], limit);
    for (const [place, line, x] of ends) { ctx.fillStyle = colour(line.ink === "grey" ? "muted" : line.ink); ctx.fillText(line.number, Math.min(x, box.left + box.width) + 5 * ratio, place); }
    ctx.restore();
    marks(u, panel);
  };
  /* events: a bar or a tick above the picture; a word where there is room, above the first one */
  const concerns = (event, panel) => !event.line || panel.lines.some(line => line.panel === event.line);
  const marks = (u, panel) => {
    const { ctx, bbox: box } = u, ratio = uPlot.pxRatio, { min, max } = u.scales.x;
    ctx.save();
    ctx.fillStyle = ctx.strokeStyle = colour("muted");
    ctx.font = `${11 * ratio}px system-ui, sans-serif`;
    ctx.textBaseline = "bottom";
    ctx.textAlign = "left";
    let free = box.left;
    for (const event of happened) {
      if (event.end < min || event.start > max || !concerns(event, panel)) continue;
      const a = Math.max(u.valToPos(event.start, "x", true), box.left), b = Math.min(u.valToPos(event.end, "x", true), box.left + box.width);
      ctx.fillRect(a, box.top - 4 * ratio, Math.max(b - a - 1.5 * ratio, 1.5 * ratio), 4 * ratio);
      /* a sentence is read beside the cursor and in the list */
      const room = event.text.length > 48 ? Infinity : ctx.measureText(event.text).width;
      if (a >= free && a + room <= box.left + box.width + 24 * ratio) { ctx.fillText(event.text, a, box.top - 6 * ratio); free = a + room + 10 * ratio; }
    }
    ctx.restore();
  };

  /* ---- the pictures */

  let panels = [], lines = [], happened = [], hot = null, whole = [0, 1], quiet = false, asked = 0;
  const group = { key: "beadline", setSeries: false };
  const plots = make("div", { className: "plots", tabIndex: 0 }), where = make("p", { className: "at" }), said = make("p", { className: "told" }), loud = make("p", { className: "vh" });
  plots.setAttribute("role", "group");
  plots.setAttribute("aria-label", `Pictures. ${KEYS}`);
  said.setAttribute("role", "status");
  loud.setAttribute("aria-live", "polite");
  const tell = text => { said.textContent = [said.textContent, text].filter(Boolean).join(" "); };
  const view = () => state.x ?? whole;
  const span = () => Math.max(plots.clientWidth || 600, 240);
  const style = () => ({ stroke: colour("muted"), font: "12px system-ui, sans-serif", grid: { stroke: colour("rule"), width: 1 }, ticks: { stroke: colour("grey"), width: 1, size: 4 } });
  const heading = panel => {
    const labels = [...new Set(panel.lines.filter(line => !line.beside).map(line => line.id === "difference" ? `Difference: ${line.name}` : byName[state.t].lines.find(one => one.name === line.column).label))];
    const groups = [...new Set(panel.lines.map(line => byName[state.t].lines.find(one => one.name === line.column)?.group))];
    return `${labels.length > 2 ? groups.join(", ") : labels.join(", ")}${panel.lines[0].unit ? `, ${panel.lines[0].unit}` : ""}`;
  };
  const build = () => {
    panels.forEach(panel => panel.plot.destroy());
    plots.replaceChildren();
    const shown = [...lines], extra = difference(lines), sets = new Map();
    if (extra) shown.push(extra);
    shown.forEach((line, i) => { line.number = i + 1; });
    for (const line of shown) {
      const key = line.id === "difference" ? "difference" : state.p === "unit" ? line.unit : line.panel + "\n" + line.unit;
      sets.set(key, [...(sets.get(key) ?? []), line]);
    }
    panels = [...sets.values()].map(mine => ({ lines: mine }));
    panels.forEach(panel => dress(panel.lines));
    const tall = panels.length === 1 ? 380 : panels.length <= 3 ? 270 : 190;
    panels.forEach((panel, i) => {
      const list = make("ol"), box = make("div"), title = make("h2", { textContent: heading(panel) });
      const last = i === panels.length - 1, x = byName[state.t].x;
      panel.box = make("section", { className: "drawn" }, title, list, box, ...(last ? [make("p", { className: "axis", textContent: x.label + (x.unit ? `, ${x.unit}` : "") })] : []));
      panel.box.setAttribute("aria-label", title.textContent);
      plots.append(panel.box);
      panel.values = panel.lines.map(line => row(list, line, panel));
      panel.plot = new uPlot({
        width: span(), height: tall, padding: [happened.some(event => concerns(event, panel)) ? 22 : 10, 24, 0, 0], legend: { show: false },
        scales: { x: { time: false, range: (u, low, high) => [low, high] }, y: { range: (u, low, high) => [low, high] } },
        series: [{}, { paths: () => null, points: { show: false } }],
        axes: [{ ...style(), size: 30, space: 70 }, { ...style(), space: 34, size: (u, values) => room(values) }],
        cursor: { sync: group, y: false, points: { show: false }, drag: { x: true, y: false, setScale: true }, bind: { dblclick: () => () => { zoom(null); return null; } } },
        hooks: { draw: [u => paint(u, panel)], setScale: [(u, key) => key === "x" && zoomed(u)], setCursor: [u => moved(u)] },
      }, [whole, [0, 0]], box);
      panel.plot.root.querySelector("canvas").setAttribute("role", "img");
      panel.plot.root.querySelector("canvas").setAttribute("aria-label", `${title.textContent}: ${panel.lines.map(line => `${line.number} ${line.name}`).join("; ")}`);
    });
    everywhere(view());
    list_events();
    point(state.c);
  };
  /* the same room on the left of all, as much as the longest number needs */
  let gutter = 48;
  const room = values => { gutter = Math.max(gutter, 16 + 7.5 * Math.max(...(values ?? [""]).map(value => `${value}`.length))); return gutter; };
  const row = (list, line, panel) => {
    /* the title says the quantity where there is one */
    const alone = new Set(panel.lines.filter(each => !each.beside).map(each => each.column)).size === 1 && !line.beside;
    const value = make("b"), drawn = page.createElementNS("http://www.w3.org/2000/svg", "svg"), stroke = page.createElementNS("http://www.w3.org/2000/svg", "path");
    drawn.setAttribute("aria-hidden", "true");
    drawn.setAttribute("viewBox", "0 0 26 10");
    for (const [key, to] of Object.entries({ d: "M0 5H26", fill: "none", stroke: `var(--${line.ink})`, "stroke-width": line.wide + 0.4, "stroke-dasharray": line.dash.join(" ") })) stroke.setAttribute(key, to);
    drawn.append(stroke);
    const item = make("li", {}, drawn, make("span", { textContent: `${line.number}` }), make("bdi", { textContent: alone && line.label ? line.label : line.name }), value);
    item.onpointerenter = () => { hot = line; panel.plot.redraw(false); };
    item.onpointerleave = () => { hot = null; panel.plot.redraw(false); };
    list.append(item);
    return value;
  };

  /* ---- zoom and cursor, one for all pictures */

  const everywhere = ([min, max]) => {
    const before = gutter;
    quiet = true;
    panels.forEach(panel => panel.plot.batch(() => {
      const [low, high] = extent(panel.lines, min, max);
      panel.plot.setScale("x", { min, max });
      panel.plot.setScale("y", { min: low, max: high });
    }));
    if (gutter > before) panels.forEach(panel => panel.plot.redraw(false, true));
    quiet = false;
  };
  const zoomed = u => {
    const { min, max } = u.scales.x;
    if (quiet || min == null || !panels.length || (min === view()[0] && max === view()[1])) return;
    zoom([min, max]);
  };
  const zoom = range => {
    if (range) {
      const wide = Math.min(Math.max(range[1] - range[0], (whole[1] - whole[0]) * 1e-6), whole[1] - whole[0]);
      const low = Math.max(whole[0], Math.min(range[0], whole[1] - wide));
      range = wide >= (whole[1] - whole[0]) * (1 - 1e-9) ? null : [low, low + wide];
    }
    state.x = range;
    everywhere(view());
    write();
  };
  const scale = factor => {
    const [low, high] = view(), middle = state.c !== null && state.c >= low && state.c <= high ? state.c : (low + high) / 2;
    zoom([middle - (middle - low) * factor, middle + (high - middle) * factor]);
  };
  const pan = share => { const [low, high] = view(), by = share * (high - low); zoom([low + by, high + by]); };
  let moving = false;
  const moved = u => {
    if (moving || u.cursor.left == null || u.cursor.left < 0 || !panels.length) return;
    /* on the sample that is next to the pointer */
    const value = u.posToVal(u.cursor.left, "x"), line = panels[0].lines[0];
    told(line.n ? at(line, nearest({ ...line, steps: false }, value)) : value);
  };
  const told = (value, aloud = false) => {
    state.c = value;
    const x = byName[state.t].x, now = value === null ? [] : happened.filter(event => event.start <= value && value <= event.end);
    where.replaceChildren(...(value === null ? [make("bdi", { textContent: "Point at a picture to read its values." })] : [make("b", { textContent: withUnit(value, x.unit) }), ` ${x.label}`, ...(now.length ? [" · ", make("bdi", { textContent: now.slice(0, 3).map(event => event.text).join("; ") + (now.length > 3 ? ` and ${now.length - 3} more` : "") })] : [])]));
    panels.forEach(panel => panel.lines.forEach((line, i) => {
      const inside = value !== null && line.n && value >= at(line, 0) && value <= at(line, line.n - 1);
      panel.values[i].textContent = inside ? withUnit(line.y[nearest(line, value)], line.unit) : "";
    }));
    if (aloud) loud.textContent = `${where.textContent}: ${panels.flatMap(panel => panel.lines.map((line, i) => `${line.name} ${panel.values[i].textContent}`)).slice(0, 6).join("; ")}`;
    write();
  };
  const point = (value, aloud = false) => {
    told(value, aloud);
    moving = true;
    panels.forEach(panel => panel.plot.setCursor(value === null ? { left: -10, top: -10 } : { left: panel.plot.valToPos(value, "x"), top: 10 }, false));
    moving = false;
  };
  plots.addEventListener("keydown", event => {
    const line = panels[0]?.lines[0], step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!line || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "+" || event.key === "=") scale(0.5);
    else if (event.key === "-") scale(2);
    else if (event.key === "0") zoom(null);
    else if (step && event.shiftKey) pan(step * 0.25);
    else if (step) {
      const [low, high] = view(), many = Math.max(1, Math.round((position(line, high) - position(line, low)) / 400));
      const k = state.c === null || state.c < low || state.c > high ? position(line, (low + high) / 2) : nearest({ ...line, steps: false }, state.c) + step * many;
      point(at(line, Math.max(0, Math.min(k, line.n - 1))), true);
    } else return;
    event.preventDefault();
  });
  plots.addEventListener("wheel", event => {
    /* the wheel alone scrolls the page */
    if (!event.ctrlKey || !panels.length) return;
    event.preventDefault();
    scale(event.deltaY < 0 ? 0.8 : 1.25);
  }, { passive: false });

  /* ---- events as a list */

  const list = make("details", { className: "events" });
  const list_events = () => {
    const unit = byName[state.t].x.unit, left = byName[state.t].events_left_out;
    list.hidden = !happened.length;
    list.replaceChildren(make("summary", { textContent: `Events: ${happened.length}${left ? `; ${left} later ones of this table are only in its Parquet file` : ""}` }), make("ol", {}, ...happened.map(event => make("li", {},
      make("button", { type: "button", textContent: event.start === event.end ? withUnit(event.start, unit) : `${say(event.start)} to ${withUnit(event.end, unit)}`, onclick: () => { const [low, high] = view(); if (event.start < low || event.start > high) zoom([event.start - (high - low) / 2, event.start + (high - low) / 2]); point(event.start, true); } }),
      make("bdi", { textContent: event.text })))));
  };

  /* ---- what is shown as CSV: the lines, over the time that is seen; times to the last digit, values as float32 */

  const short = v => { if (isNaN(v)) return ""; for (let digits = 6; digits < 9; digits++) { const text = v.toPrecision(digits); if (Math.fround(+text) === v) return String(+text); } return String(+v.toPrecision(9)); };
  const quoted = text => /[",\n]/.test(text) ? `"${text.replace(/"/g, '""')}"` : text;
  const csv = () => {
    const shown = panels.flatMap(panel => panel.lines), [low, high] = view(), x = byName[state.t].x, reach = shown.map(line => { const first = position(line, low); let last = position(line, high); while (last < line.n && at(line, last) <= high) last++; return [first, last]; });
    const next = reach.map(([first]) => first), out = [[`${x.name}`, ...shown.map(line => line.id === "difference" ? `difference ${state.diff.join(" minus ")} [${line.raw}]` : `${line.column} [${line.raw}] ${line.id.split("|").slice(1).join(" | ")}`)].map(quoted).join(",")];
    for (;;) {
      let now = Infinity;
      shown.forEach((line, i) => { if (next[i] < reach[i][1]) now = Math.min(now, at(line, next[i])); });
      if (now === Infinity) break;
      out.push(`${now},${shown.map((line, i) => {
        if (next[i] >= reach[i][1] || at(line, next[i]) !== now) return "";
        return short(line.y[next[i]++]);
      }).join(",")}`);
    }
    return out.join("\n") + "\n";
  };
  const save = () => {
    const link = make("a", { href: URL.createObjectURL(new Blob([csv()], { type: "text/csv" })), download: `${state.t}.csv` });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  };

  /* ---- what is chosen */

  let fields = 0;
  const field = (label, control) => { control.id = `choose-${++fields}`; return make("div", { className: "field" }, make("label", { htmlFor: control.id, textContent: label }), control); };
  const boxes = (label, values, words, on, change) => {
    const inputs = values.map((value, i) => make("input", { type: "checkbox", checked: on.includes(value), onchange: () => change(values.filter((_, k) => inputs[k].checked)) }));
    const narrow = words.every(word => word.length <= 12) ? "short" : "";
    return make("fieldset", {}, make("legend", { textContent: label }), make("div", { className: narrow }, ...inputs.map((input, i) => make("label", {}, input, make("bdi", { textContent: words[i] })))));
  };
  const several = (label, values, words, on, change) => {
    const select = make("select", { multiple: true, size: 6 }, ...values.map((value, i) => make("option", { value, textContent: words[i], selected: on.includes(value) })));
    select.onchange = () => change([...select.selectedOptions].map(option => option.value));
    return field(label, select);
  };
  const one = (label, values, words, on, change) => {
    const select = make("select", {}, ...values.map((value, i) => make("option", { value, textContent: words[i], selected: on === value })));
    select.onchange = () => change(select.value);
    return field(label, select);
  };
  const choose = make("details", { className: "choose", open: innerWidth > 860 }), form = make("div");
  choose.append(make("summary", { textContent: "What is shown" }), form);
  const controls = () => {
    const table = byName[state.t], focus = [...form.querySelectorAll("input, select")].indexOf(page.activeElement);
    const groups = [...new Set(mains(table).map(line => line.group))];
    const parts = [one("Series", tables.map(each => each.name), tables.map(each => each.title), state.t, t => apply({ t }))];
    for (const key of table.keys) {
      const change = values => { state.keys[key.name] = values; refresh(); };
      if (key.values.length > 1) parts.push((key.values.length > 10 ? several : boxes)(key.label, key.values, key.words, state.keys[key.name], change));
    }
    for (const each of groups) {
      const mine = mains(table).filter(line => line.group === each).map(line => line.name), words = mine.map(name => table.lines.find(line => line.name === name).label);
      parts.push(boxes(each, mine, words, state.y, on => { state.y = mains(table).map(line => line.name).filter(name => mine.includes(name) ? on.includes(name) : state.y.includes(name)); refresh(); }));
    }
    parts.push(one("Pictures", ["signal", "unit"], ["one per quantity", "one per unit"], state.p, p => { state.p = p; refresh(); }));
    if (lines.length > 1) {
      const ids = ["", ...lines.map(line => line.id)], words = ["none", ...lines.map((line, i) => `${i + 1} ${line.name}`)];
      parts.push(one("Difference: of", ids, words, state.diff?.[0] ?? "", id => { state.diff = id ? [id, state.diff?.[1] ?? lines.find(line => line.id !== id && line.raw === lines.find(each => each.id === id).raw)?.id ?? ids[1]] : null; refresh(); }));
      if (state.diff) parts.push(one("less", ids.slice(1), words.slice(1), state.diff[1], id => { state.diff = [state.diff[0], id]; refresh(); }));
    }
    form.replaceChildren(...parts);
    if (focus >= 0) [...form.querySelectorAll("input, select")][focus]?.focus();
    /* a file that is too large to lie beside the page is named, and not linked: who reads has perhaps the pages alone */
    const beside = !table.link.startsWith("../");
    if (beside) parquet.href = table.link; else parquet.removeAttribute("href");
    parquet.textContent = beside ? `Parquet, ${table.size}` : `Parquet, ${table.size}: ${table.path} of the project`;
  };
  const button = (text, label, act) => { const made = make("button", { type: "button", textContent: text, onclick: act }); if (label) made.setAttribute("aria-label", label); return made; };
  const parquet = make("a", { href: "#" });
  const tools = make("div", { className: "tools" }, button("Whole", "Show the whole time", () => zoom(null)), button("−", "Zoom out", () => scale(2)), button("+", "Zoom in", () => scale(0.5)),
    button("◂", "Earlier", () => pan(-0.25)), button("▸", "Later", () => pan(0.25)), button("CSV of what is shown", "", save), parquet);

  /* ---- from state to pictures */

  const refresh = async () => {
    const turn = ++asked, list = wanted();
    said.textContent = "";
    state.complaints.splice(0).forEach(tell);
    if (!list.length) tell(chosen().length ? "No line is chosen." : "No run has all of what is chosen; choose another value.");
    if (list.length > MOST) tell(`${list.length} lines are chosen; the first ${MOST} are drawn. Choose fewer to see the others.`);
    try {
      const found = await fetched(list.slice(0, MOST));
      if (turn !== asked) return;
      lines = found;
    } catch (error) {
      if (turn !== asked) return;
      lines = [];
      tell(error.message);
    }
    const table = byName[state.t], mine = new Set(chosen().map(run => run.codes.join())), several = mine.size > 1;
    happened = table.events.filter(([codes]) => mine.has(codes.join())).flatMap(([codes, each]) => each.map(([from, to, text, line]) => ({ start: from, end: to, line, text: several ? `${text} (${table.keys.map((key, k) => state.keys[key.name].length > 1 ? key.words[codes[k]] : "").filter(Boolean).join(", ")})` : text }))).sort((a, b) => a.start - b.start);
    const filled = lines.filter(line => line.n);
    whole = filled.length ? [Math.min(...filled.map(line => at(line, 0))), Math.max(...filled.map(line => at(line, line.n - 1)))] : [0, 1];
    if (whole[0] === whole[1]) whole[1] += 1;
    if (state.diff && !state.diff.every(id => lines.some(line => line.id === id))) state.diff = null;
    if (state.x && (state.x[0] >= whole[1] || state.x[1] <= whole[0])) state.x = null;
    controls();
    build();
    write();
    performance.mark("beadline:drawn");
    root.dataset.ready = `${lines.length}`;
  };
  const apply = want => { state = complete(want); return refresh(); };
  const redress = () => panels.length && build();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redress);
  /* paper is light, and as wide as a sheet */
  let theme;
  addEventListener("beforeprint", () => { theme = page.documentElement.dataset.theme; page.documentElement.dataset.theme = "light"; panels.forEach(panel => { [0, 1].forEach(i => { panel.plot.axes[i].stroke = () => colour("muted"); panel.plot.axes[i].grid.stroke = () => colour("rule"); }); panel.plot.setSize({ width: 980, height: panel.plot.height }); }); });
  addEventListener("afterprint", () => { if (theme === undefined) delete page.documentElement.dataset.theme; else page.documentElement.dataset.theme = theme; redress(); });
  addEventListener("hashchange", () => { if (location.hash !== written) apply(read()); });
  let width = 0;
  new ResizeObserver(() => { if (span() === width || matchMedia("print").matches) return; width = span(); panels.forEach(panel => panel.plot.setSize({ width, height: panel.plot.height })); }).observe(plots);
  root.append(choose, make("div", {}, tools, said, where, loud, plots, list));
  root.hidden = false;
  load("uPlot").then(() => apply(read())).catch(error => tell(error.message));
})();
