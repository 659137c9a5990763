/* The runs: filters of the table, two runs side by side, one column against another. What is chosen stands in the
   address. Nothing is fetched but the curves beside the page, by script elements. */
(() => {
  const page = document, { runs, texts, kinds, columns, loops } = JSON.parse(page.getElementById("data").textContent);
  const make = (tag, set = {}, ...inside) => { const made = Object.assign(page.createElement(tag), set); made.append(...inside); return made; };
  const SVG = "http://www.w3.org/2000/svg";
  const draw = (tag, set = {}, ...inside) => { const made = page.createElementNS(SVG, tag); for (const [key, value] of Object.entries(set)) made.setAttribute(key, value); made.append(...inside); return made; };
  const endless = value => value === "inf" ? Infinity : value === "-inf" ? -Infinity : value;
  /* figures as [value, low, high]; parameters from the changes that each run made to the one before it */
  let held = {};
  for (const run of runs) {
    run.figures = run.figures.map(triple => triple && (triple.length === 1 ? [triple[0], triple[0], triple[0]] : triple).map(endless));
    if (run.changes.length) held = { ...held };
    for (let i = 0; i < run.changes.length; i += 2) { const key = texts[run.changes[i]]; if (run.changes[i + 1] < 0) delete held[key]; else held[key] = texts[run.changes[i + 1]]; }
    run.parameters = held;
    run.drawn = run.curves.map((code, k) => { const [name, who, across, up] = texts[code].split("\n"); return { name, who, across, up, k }; });
  }
  const byId = new Map(runs.map(run => [run.id, run]));
  const label = run => `${run.name}, ${kinds[run.kind]}${run.date ? `, ${run.date}` : ""}`;
  const say = value => value === Infinity ? "never" : value === 0 ? "0" : Math.abs(value) >= 1e7 || Math.abs(value) < 1e-4 ? value.toExponential(3).replace("-", "\u2212") : (+value.toPrecision(4)).toLocaleString("en", { maximumFractionDigits: 9 }).replace("-", "\u2212");
  const unit = column => column.unit ? `\u202f${column.unit}` : "";
  const inDegrees = (value, column) => value === Infinity ? column.beyond : say(value) + unit(column);
  const title = column => `${column.title}${column.loop ? ` (${column.loop})` : ""}`;

  /* ---- the state and its address */

  /* the last run beside the last accepted one that had other figures */
  const last = runs.length - 1, same = run => JSON.stringify(run.figures) === JSON.stringify(runs[last].figures);
  const first = runs.findLastIndex((run, i) => i < last && run.kind === 0 && !same(run));
  const state = { a: runs[first < 0 ? Math.max(last - 1, 0) : first].id, b: runs[last].id, x: "", y: "", curve: "", kinds: kinds.map((_, k) => k), find: "" };
  const complaints = [];
  const wanted = new URLSearchParams(location.hash.slice(1));
  for (const key of ["a", "b"]) if (wanted.has(key)) { if (byId.has(wanted.get(key))) state[key] = wanted.get(key); else complaints.push(`There is no run ${wanted.get(key)} here.`); }
  for (const key of ["x", "y", "curve", "find"]) if (wanted.has(key)) state[key] = wanted.get(key);
  if (wanted.has("kinds")) state.kinds = wanted.get("kinds").split(",").map(word => kinds.indexOf(word)).filter(kind => kind >= 0);
  const write = () => {
    const params = new URLSearchParams({ a: state.a, b: state.b, x: state.x, y: state.y });
    if (state.curve) params.set("curve", state.curve);
    if (state.find) params.set("find", state.find);
    if (state.kinds.length < kinds.length) params.set("kinds", state.kinds.map(kind => kinds[kind]).join(","));
    history.replaceState(null, "", `#${params}`);
  };

  /* ---- the table: which runs are left, and which two are compared */

  const table = page.getElementById("runs"), rows = [...table.tBodies[0].rows], rowOf = new Map(rows.map((row, i) => [runs[last - i], row]));
  const left = () => runs.filter(run => !rowOf.get(run).hidden);
  const filter = () => {
    const words = state.find.toLowerCase().split(/\s+/).filter(Boolean);
    runs.forEach(run => {
      const row = rowOf.get(run);
      if (words.length) run.text ??= row.textContent.toLowerCase();
      row.hidden = !state.kinds.includes(run.kind) || !words.every(word => run.text.includes(word));
    });
    shown.textContent = `${left().length} of ${runs.length} runs`;
  };
  const shown = make("p", { className: "lead", role: "status" });
  const present = [...new Set(runs.map(run => run.kind))].sort();
  const filters = page.getElementById("filters");
  const find = make("input", { type: "search", id: "find", value: state.find, oninput: () => { state.find = find.value; filter(); cloud(); write(); } });
  filters.append(make("div", { className: "fields" },
    make("div", { className: "field" }, make("label", { htmlFor: "find", textContent: "Only rows with" }), find),
    make("fieldset", {}, make("legend", { textContent: "Kinds" }), ...present.map(kind => {
      const box = make("input", { type: "checkbox", checked: state.kinds.includes(kind), onchange: () => { state.kinds = box.checked ? [...state.kinds, kind].sort() : state.kinds.filter(other => other !== kind); filter(); cloud(); write(); } });
      return make("label", {}, box, kinds[kind]);
    }))), shown);
  const buttons = [];
  for (const run of runs) {
    /* by keyboard the two lists below do the same: no two thousand stops on the way there */
    const pair = ["a", "b"].map(side => make("button", { type: "button", className: "ab", tabIndex: -1, textContent: side.toUpperCase(), ariaLabel: `${run.name} as run ${side.toUpperCase()}`, onclick: () => { state[side] = run.id; compare(); write(); } }));
    buttons.push(pair);
    rowOf.get(run).cells[0].append(make("span", { className: "pick" }, ...pair));
  }
  const marked = () => runs.forEach((run, i) => {
    ["a", "b"].forEach((side, k) => { const on = state[side] === run.id; buttons[i][k].setAttribute("aria-pressed", on); rowOf.get(run).classList.toggle(`is-${side}`, on); });
  });

  /* ---- two runs side by side */

  const side = page.getElementById("side");
  const choose = (id, name, options, on, change) => {
    const select = make("select", { id }, ...options.map(([value, text]) => make("option", { value, textContent: text, selected: value === on })));
    select.onchange = () => change(select.value);
    return make("div", { className: "field" }, make("label", { htmlFor: id, textContent: name }), select);
  };
  const change = (column, a, b) => {
    if (!a || !b) return ["", false];
    if (a.every((end, i) => end === b[i])) return ["unchanged", false];
    const exact = a[1] === a[2] && b[1] === b[2];
    if (!exact && b[1] <= a[2] && a[1] <= b[2]) return ["within noise", false];
    if (a[0] === b[0]) return ["same value, another band", false];
    const word = (b[0] < a[0]) !== column.more ? "better" : "worse", size = b[0] - a[0];
    if (!isFinite(size)) return [word, true];
    const by = column.unit === "%" ? "\u202fpoints" : unit(column);
    return [`${size > 0 ? "+" : "\u2212"}${say(Math.abs(size))}${by} · ${column.loop ? word : "another value"}`, true];
  };
  const cell = (run, column, i) => {
    const triple = run.figures[i];
    if (!triple) return make("td", {}, make("strong", { textContent: "Not measured: " }), make("bdi", { textContent: texts[run.missing[i]] }));
    const bad = column.limit !== null && (column.more ? triple[0] < column.limit : triple[0] > column.limit);
    const band = triple[1] === triple[2] ? "no band" : `${say(triple[1])}${triple[1] < 0 ? " to " : "\u2013"}${say(triple[2])}`;
    return make("td", { className: bad ? "bad" : "" }, inDegrees(triple[0], column), make("span", { className: "b", textContent: band }));
  };
  const headed = (name, ...heads) => make("thead", {}, make("tr", {}, ...[name, ...heads].map(text => make("th", { scope: "col" }, make("bdi", { textContent: text })))));
  const scrolled = (name, ...inside) => make("div", { className: "scroll", tabIndex: 0, role: "group", ariaLabel: name }, make("table", { className: "tab" }, ...inside));
  const figures = (a, b) => {
    const body = make("tbody");
    loops.forEach((loop, k) => {
      body.append(make("tr", {}, make("th", { scope: "row", textContent: `${loop[0].toUpperCase()}${loop.slice(1)}: verdict, controller` }), ...[a, b].map(run => make("td", {}, run.verdicts[k] || "none kept", make("span", { className: "b" }, make("bdi", { textContent: run.who[k] || "" })))), make("td", { textContent: a.verdicts[k] === b.verdicts[k] && a.who[k] === b.who[k] ? "unchanged" : "changed" })));
    });
    columns.forEach((column, i) => {
      if (!a.figures[i] && !b.figures[i] && texts[a.missing[i]] === texts[b.missing[i]] && !column.loop) return;
      const [text, moved] = change(column, a.figures[i], b.figures[i]);
      body.append(make("tr", {}, make("th", { scope: "row" }, make("bdi", { textContent: column.title }), make("span", { className: "b", textContent: column.loop })), cell(a, column, i), cell(b, column, i), make("td", { className: moved ? "moved" : "", textContent: text })));
    });
    return scrolled("Figures of both runs", headed("Figure", `A: ${a.name}`, `B: ${b.name}`, "From A to B"), body);
  };
  const parameters = (a, b) => {
    const why = [a, b].filter(run => run.none).map(run => `${run.name}: ${run.none}.`);
    if (why.length) return make("p", { className: "finding" }, make("strong", { textContent: "Parameters are not measured. " }), make("bdi", { textContent: why.join(" ") }));
    const keys = [...new Set([...Object.keys(a.parameters), ...Object.keys(b.parameters)])].filter(key => a.parameters[key] !== b.parameters[key]).sort();
    if (!keys.length) return make("p", { className: "finding", textContent: `All ${Object.keys(a.parameters).length} parameters are the same.` });
    const body = make("tbody", {}, ...keys.slice(0, 300).map(key => make("tr", {}, make("th", { scope: "row" }, make("code", { textContent: key })), ...[a, b].map(run => make("td", {}, make("bdi", { textContent: run.parameters[key] ?? "not set" }))))));
    const more = keys.length > 300 ? [make("p", { className: "lead", textContent: `${keys.length - 300} more differ: compare with dvc params diff.` })] : [];
    return make("div", {}, scrolled("Parameters that differ", headed("Parameter that differs", `A: ${a.name}`, `B: ${b.name}`), body), ...more);
  };

  /* curves: base64 -> numbers, each file once */
  const loaded = {}, waiting = {};
  const bytes = text => Uint8Array.from(atob(text), letter => letter.charCodeAt(0)).buffer;
  window.beadlineSeries = (name, size, at, text) => { loaded[name] = size === 8 ? new Float64Array(bytes(text)) : new Float32Array(bytes(text)); };
  const load = file => waiting[file] ??= new Promise((done, failed) => page.head.append(make("script", {
    src: `runs/${file}.js`, onload: () => done(),
    onerror: () => { delete waiting[file]; failed(new Error(`runs/${file}.js cannot be read. It belongs beside this page: copy the folder "runs" with it, or run ./run beadline runs.`)); },
  })));
  const colour = name => getComputedStyle(page.documentElement).getPropertyValue(`--${name}`).trim();
  const charts = make("div"), DASHES = { a: [], b: [7, 4] };
  let plot = null, asked = 0;
  const swatch = key => draw("svg", { viewBox: "0 0 28 10", "aria-hidden": "true" }, draw("path", { d: "M0 5H28", fill: "none", stroke: `var(--${key === "a" ? "ink" : "blue"})`, "stroke-width": 2, "stroke-dasharray": DASHES[key].join(" ") }));
  const curves = async (a, b) => {
    const turn = ++asked, names = [...new Set([...a.drawn, ...b.drawn].map(curve => curve.name))];
    plot?.destroy();
    plot = null;
    charts.replaceChildren();
    const gaps = [...new Set([a, b])].filter(run => texts[run.why]).map(run => make("p", { className: "finding" }, make("strong", { textContent: `Curves of ${run.name}, not measured: ` }), make("bdi", { textContent: `${texts[run.why]}.` })));
    if (!names.length) { charts.append(make("h3", { textContent: "Curves" }), ...gaps); return; }
    if (!names.includes(state.curve)) state.curve = names[0];
    const box = make("div", { className: "chartbox" }), mine = [["a", a], ["b", b]].map(([key, run]) => [key, run, run.drawn.find(curve => curve.name === state.curve)]).filter(([, , curve]) => curve);
    const values = new Map(mine.map(([key]) => [key, make("b")]));
    charts.append(make("h3", { textContent: "Curves on one axis" }), make("div", { className: "fields" }, choose("curve", "Curve", names.map(name => [name, name]), state.curve, name => { state.curve = name; curves(a, b); write(); })), make("div", { className: "keyab" }, ...mine.map(([key, run, curve]) => make("span", {}, swatch(key), make("bdi", { textContent: `${key.toUpperCase()}: ${run.name}${curve.who ? `, ${curve.who}` : ""}` }), values.get(key)))), box, ...gaps);
    try {
      await Promise.all(["uPlot", ...mine.map(([, run]) => run.file)].map(load));
    } catch (error) {
      if (turn === asked) box.append(make("p", { className: "finding bad", textContent: error.message }));
      return;
    }
    if (turn !== asked) return;
    const joined = uPlot.join(mine.map(([, run, curve]) => [loaded[`${run.file}.${curve.k}.x`], loaded[`${run.file}.${curve.k}`]].map(part => [...part])));
    const { across, up } = mine[0][2], font = "12px system-ui, sans-serif", axis = { stroke: () => colour("muted"), grid: { stroke: () => colour("rule"), width: 1 }, ticks: { show: false }, font };
    box.append(make("p", { className: "axis", textContent: `${state.curve}, ${up}` }));
    const at = make("div", { role: "img", tabIndex: 0, ariaLabel: `${state.curve}: ${mine.map(([key, run]) => `${key.toUpperCase()} ${run.name}`).join(" and ")} over ${across}` });
    box.append(at, make("p", { className: "axis down", textContent: across }));
    const tell = u => mine.forEach(([key], k) => {
      let i = u.cursor.idx;
      while (i !== null && i > 0 && joined[k + 1][i] == null) i--;
      values.get(key).textContent = i === null || joined[k + 1][i] == null ? "" : `${say(joined[k + 1][i])} at ${say(joined[0][i])}`;
    });
    plot = new uPlot({
      width: box.clientWidth, height: 280, legend: { show: false }, scales: { x: { time: false } }, hooks: { setCursor: [tell] },
      series: [{}, ...mine.map(([key]) => ({ stroke: () => colour(key === "a" ? "ink" : "blue"), width: 1.6, dash: DASHES[key], spanGaps: true, points: { show: false } }))],
      axes: [{ ...axis, space: 60 }, { ...axis, size: 56 }],
    }, joined, at);
    at.onkeydown = event => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (!step) return;
      event.preventDefault();
      const to = Math.max(0, Math.min((plot.cursor.idx ?? 0) + step * Math.ceil(joined[0].length / 100), joined[0].length - 1));
      plot.setCursor({ left: plot.valToPos(joined[0][to], "x"), top: 10 });
    };
    page.documentElement.dataset.curve = state.curve;
  };
  const compare = () => {
    const a = byId.get(state.a), b = byId.get(state.b), options = [...runs].reverse().map(run => [run.id, label(run)]), focus = page.activeElement?.id;
    side.replaceChildren(
      make("div", { className: "fields" }, choose("run-a", "Run A", options, a.id, id => { state.a = id; compare(); write(); }), choose("run-b", "Run B", options, b.id, id => { state.b = id; compare(); write(); })),
      ...complaints.splice(0).map(text => make("p", { className: "finding bad", textContent: text })),
      figures(a, b), make("h3", { textContent: "Parameters" }), parameters(a, b), charts);
    if (focus === "run-a" || focus === "run-b") page.getElementById(focus).focus();
    marked();
    curves(a, b);
  };

  /* ---- one column against another */

  const place = page.getElementById("cloud"), plain = key => key.startsWith("parameter ");
  const varied = (() => {
    const seen = new Map();
    let before = null;
    for (const run of runs) if (!run.none) {
      if (before !== run.parameters) for (const [key, value] of Object.entries(run.parameters)) { if (!seen.has(key)) seen.set(key, new Set()); seen.get(key).add(value); }
      before = run.parameters;
    }
    return [...seen].filter(([, values]) => values.size > 1).map(([key]) => key).sort();
  })();
  const measured = columns.filter((_, i) => runs.some(run => run.figures[i] && isFinite(run.figures[i][0])));
  const axes = [["date", "Order in time"], ...measured.map(column => [column.key, title(column)]), ...varied.map(key => [`parameter ${key}`, `Parameter ${key}`])];
  const known = (key, other) => axes.some(([name]) => name === key) ? key : other;
  state.x = known(state.x, measured.some(column => column.key === "temperature.settling") ? "temperature.settling" : "date");
  state.y = measured.some(column => column.key === state.y) ? state.y : measured.some(column => column.key === "setpoint.stay") ? "setpoint.stay" : measured[0]?.key ?? "";
  const natural = (p, q) => p.localeCompare(q, "en", { numeric: true });
  const value = (run, key) => key === "date" ? runs.indexOf(run) + 1 : plain(key) ? run.none ? undefined : run.parameters[key.slice(10)] : run.figures[columns.findIndex(column => column.key === key)]?.[0];
  const ticks = (low, high, many) => {
    const rough = (high - low) / many, power = 10 ** Math.floor(Math.log10(rough)), step = [1, 2, 2.5, 5, 10].map(f => f * power).find(s => s >= rough * 0.999), found = [];
    for (let k = Math.ceil(low / step - 1e-9); k <= high / step + 1e-9; k++) found.push([+(k * step).toPrecision(10), say(+(k * step).toPrecision(10))]);
    return found;
  };
  const scale = (values, many, names = null) => {
    if (names) return { at: value => (names.indexOf(value) + 0.5) / names.length, ticks: names.length <= 12 ? names.map(name => [name, name.length > 14 ? `${name.slice(0, 13)}…` : name]) : [[names[0], names[0].slice(0, 14)], [names.at(-1), names.at(-1).slice(0, 14)]] };
    let low = Math.min(...values), high = Math.max(...values);
    const log = low > 0 && high > 50 * low;
    if (log) {
      const [from, to] = [Math.log10(low) - 0.05, Math.log10(high) + 0.05], found = [];
      for (let k = Math.ceil(from); k <= to; k++) found.push([10 ** k, say(10 ** k)]);
      return { log, at: value => (Math.log10(value) - from) / (to - from), ticks: found };
    }
    const room = 0.05 * (high - low) || Math.abs(high) * 0.05 || 1;
    low -= room; high += room;
    return { low, high, at: value => (value - low) / (high - low), ticks: ticks(low, high, many) };
  };
  const shapes = [
    (x, y, set) => draw("circle", { cx: x, cy: y, r: 5, ...set }), (x, y, set) => draw("rect", { x: x - 4.5, y: y - 4.5, width: 9, height: 9, ...set }),
    (x, y, set) => draw("path", { d: `M${x} ${y - 5.5}L${x + 5.5} ${y + 4.5}H${x - 5.5}Z`, ...set }), (x, y, set) => draw("circle", { cx: x, cy: y, r: 3, ...set }), (x, y, set) => draw("path", { d: `M${x} ${y - 6}L${x + 6} ${y}L${x} ${y + 6}L${x - 6} ${y}Z`, ...set }),
  ];
  let width = 0;
  const cloud = () => {
    const focus = page.activeElement?.id;
    if (!measured.length) { place.replaceChildren(make("p", { className: "finding" }, make("strong", { textContent: "Not measured. " }), "No run has a figure.")); return; }
    const column = columns.find(each => each.key === state.y), name = axes.find(([key]) => key === state.x)[1];
    const numeric = run => { const v = value(run, state.x); return v !== undefined && v !== "" && isFinite(v); };
    const having = left().filter(run => value(run, state.x) !== undefined && isFinite(value(run, state.y) ?? NaN));
    const category = plain(state.x) && !having.every(numeric), used = category ? having : having.filter(numeric);
    const points = used.map(run => ({ run, x: category ? value(run, state.x) : +value(run, state.x), y: value(run, state.y) }));
    const said = make("p", { className: "said-now", role: "status" }), pts = make("div", { className: "pts" });
    place.replaceChildren(
      make("div", { className: "fields" }, choose("across", "Across", axes, state.x, key => { state.x = key; cloud(); write(); }), choose("up", "Up", measured.map(each => [each.key, title(each)]), state.y, key => { state.y = key; cloud(); write(); })),
      make("p", { className: "lead", textContent: `${points.length} of ${runs.length} runs have both, and are left by the filters.` }), pts,
      make("ul", { className: "legend" }, ...[...new Set(points.map(point => point.run.kind))].sort().map(kind => make("li", {}, draw("svg", { viewBox: "0 0 14 14", "aria-hidden": "true", class: "pts" }, shapes[kind](7, 7, { class: `p k${kind}` })), kinds[kind]))), said);
    if (focus === "across" || focus === "up") page.getElementById(focus).focus();
    if (!points.length) return;
    width = Math.min(pts.clientWidth, 860);
    const tall = width < 500 ? 300 : 360, [l, r, above, below] = [56, 14, 26, 40], names = category ? [...new Set(points.map(point => point.x))].sort(natural) : null;
    const across = scale(points.map(point => point.x), width < 500 ? 3 : 6, names), up = scale(points.map(point => point.y), 5);
    const px = v => l + across.at(v) * (width - l - r), py = v => tall - below - up.at(v) * (tall - above - below);
    const svg = draw("svg", { width, height: tall, viewBox: `0 0 ${width} ${tall}`, role: "img", tabindex: 0, "aria-label": `${title(column)} over ${name}: ${points.length} runs` });
    for (const [v, text] of up.ticks) svg.append(draw("line", { class: "tk", x1: l, x2: width - r, y1: py(v), y2: py(v) }), draw("text", { x: l - 6, y: py(v) + 4, "text-anchor": "end" }, text));
    const room = category ? (width - l - r) / names.length : Infinity;
    across.ticks.forEach(([v, text], k) => { if (room < 64 && k % Math.ceil(64 / room)) return; svg.append(draw("line", { class: "ax", x1: px(v), x2: px(v), y1: tall - below, y2: tall - below + 4 }), draw("text", { x: px(v), y: tall - below + 17, "text-anchor": "middle" }, text)); });
    svg.append(draw("line", { class: "ax", x1: l, x2: width - r, y1: tall - below, y2: tall - below }), draw("text", { x: 0, y: 14 }, `${column.title}${column.unit ? `, ${column.unit}` : ""}${up.log ? ", log" : ""}`), draw("text", { x: width - r, y: tall - 6, "text-anchor": "end" }, `${name.length > 60 ? `…${name.slice(-58)}` : name}${columns.find(each => each.key === state.x)?.unit ? `, ${columns.find(each => each.key === state.x).unit}` : ""}${across.log ? ", log" : ""}`));
    if (column.limit !== null && up.low <= column.limit && column.limit <= up.high) svg.append(draw("line", { class: "lim", x1: l, x2: width - r, y1: py(column.limit), y2: py(column.limit) }), draw("text", { x: width - r, y: py(column.limit) - 4, "text-anchor": "end" }, `limit ${say(column.limit)}`));
    if (plain(state.x)) {
      const tried = points.filter(point => kinds[point.run.kind] === "experiment"), where = [...new Set(tried.map(point => point.x))].sort((p, q) => category ? natural(p, q) : p - q);
      const median = values => { values.sort((p, q) => p - q); const k = values.length >> 1; return values.length % 2 ? values[k] : (values[k - 1] + values[k]) / 2; };
      if (where.length > 1) svg.append(draw("path", { class: "med", d: where.map((x, k) => `${k ? "L" : "M"}${px(x)} ${py(median(tried.filter(point => point.x === x).map(point => point.y)))}`).join("") }));
    }
    let on = -1;
    const tell = k => {
      svg.querySelector(".on")?.classList.remove("on");
      on = k;
      const { run, x, y } = points[k];
      points[k].mark.classList.add("on");
      said.replaceChildren(make("b", {}, make("bdi", { textContent: run.name })), ` ${kinds[run.kind]}, ${run.date || "now"}: ${title(column)} ${inDegrees(y, column)}, ${name} `, make("bdi", { textContent: typeof x === "number" ? say(x) : x }), ` `, make("bdi", { textContent: run.subject }));
    };
    const take = k => { state.b = points[k].run.id; compare(); write(); };
    points.sort((p, q) => (category ? natural(p.x, q.x) : p.x - q.x) || p.y - q.y);
    points.forEach((point, k) => {
      point.mark = shapes[point.run.kind](px(point.x), py(point.y), { class: `p k${point.run.kind}` });
      point.mark.onpointerenter = () => tell(k);
      point.mark.onclick = () => take(k);
      svg.append(point.mark);
    });
    svg.onkeydown = event => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (event.key === "Enter" && on >= 0) take(on);
      else if (step) tell(Math.max(0, Math.min(on + step, points.length - 1)));
      else return;
      event.preventDefault();
    };
    pts.append(svg);
  };
  filter();
  compare();
  cloud();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => plot?.redraw());
  let before = page.documentElement.clientWidth;
  addEventListener("resize", () => {
    if (page.documentElement.clientWidth === before) return;
    before = page.documentElement.clientWidth;
    cloud();
    const box = page.querySelector(".chartbox");
    if (plot && box) plot.setSize({ width: box.clientWidth, height: 280 });
  });
  page.documentElement.dataset.ready = `${runs.length}`;
})();
