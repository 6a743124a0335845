"use strict";
// Draws the report from its data. Colours are those of the style sheet, so all is drawn again where the theme changes.
(() => {
  const SHOWN = 60;
  const at = (id) => document.getElementById(id);
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const views = new Map();
  let data = null, chosen = null, everything = false;

  function element(name, options = {}, ...children) {
    const made = document.createElement(name);
    for (const [key, value] of Object.entries(options)) {
      if (key === "text") made.textContent = value;
      else if (key === "class") made.className = value;
      else made.setAttribute(key, value);
    }
    made.append(...children);
    return made;
  }

  async function unpack(text) {
    const bytes = Uint8Array.from(atob(text), (each) => each.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return JSON.parse(await new Response(stream).text());
  }

  /** Seconds since the beginning, of differences in units. */
  function seconds(differences) {
    let units = 0;
    return differences.map((each) => (units += each) * data.unit / 1e9);
  }

  const clock = (time) => Date.parse(data.begin) + time * 1000;
  const short = (value) => (typeof value === "number" ? String(Number(value.toPrecision(6))) : String(value));
  const span = (time) => (time >= 120 ? `${(time / 60).toFixed(1)} min` : `${short(Number(time.toFixed(3)))} s`);
  const counted = (count, noun) => `${count.toLocaleString("en")} ${noun}${count === 1 ? "" : "s"}`;
  const timeOfDay = (time) => new Date(clock(time)).toISOString().slice(11, 23);

  /** Stretches in which a condition has a code: [from, to, place]. */
  function stretches(steps, code) {
    const times = seconds(steps.t), found = [];
    steps.c.forEach((each, place) => {
      if (each === code) found.push([times[place], place + 1 < times.length ? times[place + 1] : data.length, place]);
    });
    return found;
  }

  // The timeline

  function bars(subject) {
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    svg.setAttribute("viewBox", "0 0 1000 16");
    svg.setAttribute("preserveAspectRatio", "none");
    const scale = 1000 / (data.length || 1);
    const add = (from, to, fill, height, title) => {
      const rect = document.createElementNS(svg.namespaceURI, "rect");
      const fields = { x: from * scale, width: Math.max((to - from) * scale, 1.5), y: (16 - height) / 2, height, fill };
      for (const [key, value] of Object.entries(fields)) rect.setAttribute(key, value);
      const text = document.createElementNS(svg.namespaceURI, "title");
      text.textContent = title;
      rect.append(text);
      svg.append(rect);
    };
    const when = subject.conditions.when;
    for (const [from, to, place] of when ? stretches(when, 2) : [])
      add(from, to, colour("unknown"), 4, `unknown from ${timeOfDay(from)}: ${when.why[place] ?? ""}`);
    for (const each of subject.episodes) {
      const to = each.end ?? data.length;
      add(each.start, to, colour("open"), 12,
        `${timeOfDay(each.start)}, ${span(to - each.start)}, ${each.reason ?? "open at the end"}`);
    }
    return svg;
  }

  function drawTimeline() {
    const rows = data.subjects.filter((each) => each.episodes.length || each.unknown);
    const shown = everything ? rows : rows.slice(0, SHOWN);
    const axis = element("div", { class: "axis" }, element("span"),
      element("div", {}, ...[0, 0.5, 1].map((part) => element("span", { text: timeOfDay(data.length * part) }))));
    const made = shown.map((each) => {
      const name = element("span", { class: "name" }, `${each.rule} · ${each.subject} `,
        element("small", { text: counted(each.episodes.length, "episode") }));
      const row = element("button", { class: "row", type: "button", "aria-pressed": String(each === chosen) },
        name, bars(each));
      row.addEventListener("click", () => choose(each, true));
      return row;
    });
    if (!made.length) made.push(element("p", { class: "hint", text: "No rule started an episode." }));
    at("timeline").replaceChildren(axis, ...made);
    at("more").hidden = shown.length === rows.length;
    at("more").textContent = `Show all ${rows.length} lines`;
  }

  // Plots

  function figure(options) {
    const coarse = matchMedia("(pointer: coarse)").matches;
    const made = Bokeh.Plotting.figure({
      sizing_mode: "stretch_width", toolbar_location: coarse ? "below" : "right", background_fill_color: colour("back"),
      border_fill_color: colour("back"), outline_line_color: colour("line"), output_backend: "canvas",
      min_border_left: 60, ...options,
    });
    for (const axis of [made.xaxis, made.yaxis].flat())
      Object.assign(axis, { axis_label_text_color: colour("faint"), major_label_text_color: colour("faint"),
        axis_line_color: colour("line"), major_tick_line_color: colour("line"), minor_tick_line_color: null,
        major_label_text_font_size: "11px", axis_label_text_font_size: "11px" });
    for (const grid of [made.xgrid, made.ygrid].flat()) grid.grid_line_color = colour("line");
    made.toolbar.logo = null;
    if (coarse) made.toolbar.active_drag = null; // a finger scrolls the page
    return made;
  }

  async function put(place, made) {
    views.get(place)?.forEach((view) => view.remove());
    place.replaceChildren();
    if (made) views.set(place, [await Bokeh.Plotting.show(made, place)].flat());
  }

  /** Makes ranges of time, one a plot, that move together. */
  function linkedRanges() {
    const ranges = [];
    let moving = false;
    const follow = (moved) => {
      if (moving) return;
      moving = true;
      for (const each of ranges) if (each !== moved) each.setv({ start: moved.start, end: moved.end });
      moving = false;
    };
    return () => {
      const made = new Bokeh.Range1d({ start: clock(0), end: clock(data.length || 1) });
      for (const property of [made.properties.start, made.properties.end]) property.change.connect(() => follow(made));
      ranges.push(made);
      return made;
    };
  }

  function boxes(made, subject) {
    for (const each of subject.episodes)
      made.add_layout(new Bokeh.BoxAnnotation({ left: clock(each.start), right: clock(each.end ?? data.length),
        fill_color: colour("open"), fill_alpha: 0.13, line_color: null, level: "underlay" }));
  }

  function drawSignal(name, series, subject, range) {
    const thresholds = subject.thresholds.filter((each) => each[1] === name);
    const made = figure({ height: thresholds.length ? 190 : 130, x_axis_type: "datetime", x_range: range,
      tools: "xpan,xwheel_zoom,xbox_zoom,reset" });
    boxes(made, subject);
    const x = seconds(series.t).map(clock);
    const y = series.v.map((value) => (value === null ? NaN : value));
    x.push(clock(data.length));
    y.push(y[y.length - 1]);
    const source = new Bokeh.ColumnDataSource({ data: { x, y } });
    const line = made.step({ field: "x" }, { field: "y" }, "after", { source, line_color: colour("series"), line_width: 1.5 });
    const dots = made.scatter({ field: "x" }, { field: "y" }, { source, size: 8, fill_alpha: 0, line_alpha: 0 });
    made.add_tools(new Bokeh.HoverTool({ renderers: [dots ?? line], tooltips: [["time", "@x{%T.%3N}"], [name, "@y{0.[000000]}"]],
      formatters: { "@x": "datetime" } }));
    for (const [field, , operator, value] of thresholds) {
      const paint = colour(field === "when" ? "limit" : "limit-2");
      made.add_layout(new Bokeh.Span({ dimension: "width", location: value, line_color: paint, line_dash: [6, 4], line_width: 1.5 }));
      made.add_layout(new Bokeh.Label({ x: 4, x_units: "screen", y: value, text: `${field} ${operator} ${short(value)}`,
        text_color: paint, text_font_size: "11px", text_baseline: field === "when" ? "bottom" : "top",
        background_fill_color: colour("back"), background_fill_alpha: 0.85 }));
    }
    const known = y.filter((value) => !Number.isNaN(value)).concat(thresholds.map((each) => each[3]));
    if (known.length && thresholds.length) {
      const low = known.reduce((a, b) => Math.min(a, b)), high = known.reduce((a, b) => Math.max(a, b));
      const room = (high - low || 1) * 0.12;
      made.y_range = new Bokeh.Range1d({ start: low - room, end: high + room });
    }
    return made;
  }

  /** Conditions, booleans and texts: a bar whose colour shows the value. */
  function drawStates(rows, subject, range) {
    const source = { left: [], right: [], row: [], paint: [], text: [] };
    const add = (row, from, to, paint, text) => {
      source.left.push(clock(from)); source.right.push(clock(to)); source.row.push(row);
      source.paint.push(paint); source.text.push(text);
    };
    for (const [row, cells] of rows) for (const [from, to, paint, text] of cells) add(row, from, to, paint, text);
    const names = rows.map(([row]) => row).reverse();
    const made = figure({ height: 54 + 24 * names.length, x_axis_type: "datetime", x_range: range,
      y_range: new Bokeh.FactorRange({ factors: names }), tools: "xpan,xwheel_zoom,reset" });
    boxes(made, subject);
    made.ygrid.grid_line_color = null;
    const drawn = made.hbar({ y: { field: "row" }, left: { field: "left" }, right: { field: "right" }, height: 0.7,
      fill_color: { field: "paint" }, line_color: null, source: new Bokeh.ColumnDataSource({ data: source }) });
    made.add_tools(new Bokeh.HoverTool({ renderers: [drawn], tooltips: [["from", "@left{%T.%3N}"], ["is", "@text"]],
      formatters: { "@left": "datetime" } }));
    return made;
  }

  function stateRows(subject) {
    const paints = [colour("false"), colour("true"), colour("unknown"), null];
    const words = ["false", "true", "unknown", "away"];
    const rows = Object.entries(subject.conditions).map(([field, steps]) => [field,
      [0, 1, 2].flatMap((code) => stretches(steps, code).map(([from, to, place]) =>
        [from, to, paints[code], steps.why[place] ? `unknown: ${steps.why[place]}` : words[code]]))]);
    const texts = [colour("series"), colour("limit-2"), colour("place"), colour("limit"), colour("unknown")];
    for (const [name, place] of Object.entries(subject.signals)) {
      const series = data.series[place];
      if (series.kind === "number") continue;
      const times = seconds(series.t);
      rows.push([name, series.v.map((value, index) => {
        const to = index + 1 < times.length ? times[index + 1] : data.length;
        if (value === null) return [times[index], to, paints[2], "unknown"];
        const text = series.kind === "text" ? series.texts[value] : value ? "true" : "false";
        return [times[index], to, series.kind === "text" ? texts[value % texts.length] : paints[value], text];
      })]);
    }
    return rows;
  }

  async function drawDetail() {
    const subject = chosen, rule = data.rules.find((each) => each.name === subject.rule);
    at("text").textContent = rule?.text ?? "";
    at("description").textContent = rule?.description ?? "";
    const range = linkedRanges();
    const numbers = Object.entries(subject.signals).filter(([, place]) => data.series[place].kind === "number");
    const compared = new Set(subject.thresholds.map((each) => each[1]));
    numbers.sort(([one], [other]) => compared.has(other) - compared.has(one));
    const places = [];
    const panel = (title, note, made) => {
      const inside = element("div");
      places.push([inside, made]);
      return element("div", { class: "plot" }, element("h3", {}, title, element("small", { text: note })), inside);
    };
    const thinnedNote = (place) => ` ${counted(data.series[place].t.length, "point")}`;
    const panels = [panel("conditions", " green true, grey false, dark grey unknown", drawStates(stateRows(subject), subject, range()))];
    for (const [name, place] of numbers)
      panels.push(panel(name, thinnedNote(place), drawSignal(name, data.series[place], subject, range())));
    for (const [place, drawn] of views) if (at("plots").contains(place)) { drawn.forEach((view) => view.remove()); views.delete(place); }
    at("plots").replaceChildren(...panels);
    for (const [place, made] of places) await put(place, made);
    const rows = subject.episodes.map((each) => [timeOfDay(each.start), each.end === null ? "open" : span(each.end - each.start),
      each.reason ?? "", Object.entries(each.values).filter(([name]) => name.endsWith(".start") || name.endsWith(".max"))
        .map(([name, value]) => `${name} ${short(value)}`).join(", ")]);
    table("found", ["start", "duration", "end", "values"], rows, [0, 1]);
  }

  // Map

  async function drawMap() {
    const place = at("map");
    if (!data.paths.length) {
      at("no-map").hidden = false;
      at("no-map").textContent = "No rule defines the positions of clients: they come from a pairs scope.";
      return;
    }
    const made = figure({ height: Math.min(520, Math.max(320, place.clientWidth * 0.6)), match_aspect: true,
      tools: "pan,wheel_zoom,box_zoom,reset", x_axis_label: data.geographic ? "longitude, degrees" : "x, m",
      y_axis_label: data.geographic ? "latitude, degrees" : "y, m" });
    for (const each of data.polygons) {
      const corners = each.corners.map(([one, other]) => (data.geographic ? [other, one] : [one, other]));
      const [xs, ys] = [corners.map(([x]) => x), corners.map(([, y]) => y)];
      if (each.closed) made.patch(xs, ys, { fill_color: colour("place"), fill_alpha: 0.12, line_color: colour("place") });
      else made.line(xs, ys, { line_color: colour("place"), line_width: 2 });
    }
    const own = new Set(chosen ? chosen.clients : []);
    const lines = (paths, options) => made.multi_line({ field: "xs" }, { field: "ys" }, { ...options, source: new Bokeh.ColumnDataSource({
      data: { xs: paths.map((path) => path.x), ys: paths.map((path) => path.y), client: paths.map((path) => path.client) } }) });
    const others = lines(data.paths.filter((path) => !own.has(path.client)), { line_color: colour("unknown"), line_alpha: 0.6, line_width: 1 });
    const mine = lines(data.paths.filter((path) => own.has(path.client)), { line_color: colour("series"), line_width: 2 });
    made.add_tools(new Bokeh.HoverTool({ renderers: [others, mine], tooltips: [["client", "@client"]] }));
    const starts = { x: [], y: [], text: [] };
    for (const subject of chosen ? data.subjects.filter((each) => each.rule === chosen.rule) : [])
      for (const each of subject.episodes) {
        const path = data.paths.find((one) => one.client === subject.clients[0]);
        if (!path) continue;
        let near = path.t.findIndex((time) => time > each.start);
        near = near < 0 ? path.t.length - 1 : Math.max(0, near - 1);
        starts.x.push(path.x[near]); starts.y.push(path.y[near]);
        starts.text.push(`${subject.rule} of ${subject.subject} at ${timeOfDay(each.start)}`);
      }
    const marks = made.scatter({ field: "x" }, { field: "y" }, { source: new Bokeh.ColumnDataSource({ data: starts }), size: 7,
      fill_color: colour("open"), line_color: colour("back") });
    made.add_tools(new Bokeh.HoverTool({ renderers: [marks], tooltips: [["episode", "@text"]] }));
    at("no-map").hidden = false;
    at("no-map").textContent = `Dots: where episodes of ${chosen?.rule ?? "a rule"} start. Blue: the chosen subject. Green: areas of rules.`;
    await put(place, made);
  }

  // Tables

  function table(id, heads, rows, numbers = []) {
    const body = rows.map((row) => element("tr", {}, ...row.map((cell, column) =>
      element("td", { text: cell ?? "", class: numbers.includes(column) ? "number" : "wide" }))));
    const head = element("tr", {}, ...heads.map((text) => element("th", { text })));
    at(id).replaceChildren(...(rows.length ? [element("thead", {}, head), element("tbody", {}, ...body)] : []));
  }

  async function drawActions() {
    table("actions", ["from", "for", "rule", "subject", "action", "about"], data.actions.map(([rule, action, subject, what, about, from, to]) =>
      [timeOfDay(from), to === null ? "open" : span(to - from), rule, subject, `${action} (${what})`, about]), [0, 1]);
    if (data.actionCount > data.actions.length)
      at("actions").prepend(element("caption", { text: `The first ${data.actions.length} of ${data.actionCount}.` }));
    if (!data.actions.length) at("actions").replaceChildren(element("caption", { text: "The rules have no actions, or nothing started." }));
    const place = at("demands");
    if (!data.demands.length) return place.replaceChildren();
    const made = figure({ height: 200, x_axis_type: "datetime", tools: "xpan,xwheel_zoom,reset", y_axis_label: "demands" });
    const paints = ["series", "open", "limit-2", "place", "limit", "unknown"];
    const paint = (index) => colour(paints[index % paints.length]);
    data.demands.forEach((each, index) => made.step(each.t.concat(data.length).map(clock), each.n.concat(each.n[each.n.length - 1]),
      "after", { line_width: 2, line_color: paint(index) }));
    at("templates").replaceChildren("Tasks that demand", ...data.demands.flatMap((each, index) => {
      const key = element("span", { class: "key line" });
      key.style.background = paint(index); // no attribute: those of the page alone are let through
      return [key, each.template];
    }));
    await put(place, made);
  }

  function drawData() {
    table("streams", ["stream", "key", "encoding", "samples", "keys", "rate of a key", "longest gap", "unreadable", "without a client"],
      data.streams.map((each) => [each.stream, each.key, each.encoding, each.samples.toLocaleString("en"), each.keys,
        each.rate === null ? "" : `${short(Number(each.rate.toPrecision(4)))} Hz`,
        each.gap === null ? "" : `${span(each.gap)} at ${timeOfDay(each.gapAt)}, ${each.gapKey}`,
        each.unreadable ? `${each.unreadable}: ${each.lastUnreadable}` : 0, each.unnamed]), [3, 4, 5]);
    if (data.nearest.length)
      table("nearest", ["nearest without an episode", "subject", "at", "margin"],
        data.nearest.map(([rule, subject, time, margin]) => [rule, subject, timeOfDay(time), short(Number(margin.toPrecision(4)))]), [3]);
    table("rules", ["rule", "episodes", "subjects", "evaluations", "unknown values", "errors"], data.rules.map((each) =>
      [each.name, each.episodes, each.subjects, ...[each.evaluations, each.unknowns, each.errors].map((n) => n.toLocaleString("en"))]), [1, 2, 3, 4, 5]);
    at("notes").replaceChildren(...data.notes.map((text) => element("li", { text })));
  }

  // Choosing

  function choose(subject, scroll) {
    chosen = subject;
    at("rule").value = subject.rule;
    fillSubjects();
    at("subject").value = subject.subject;
    drawTimeline();
    if (scroll) at("detail").scrollIntoView();
    return drawDetail().then(drawMap);
  }

  function fillSubjects() {
    const own = data.subjects.filter((each) => each.rule === at("rule").value);
    at("subject").replaceChildren(...own.map((each) => element("option", { value: each.subject,
      text: `${each.subject} (${each.episodes.length})` })));
  }

  async function draw() {
    drawTimeline();
    if (chosen) await choose(chosen, false);
    else await drawMap();
    await drawActions();
    drawData();
    document.documentElement.dataset.drawn = String(Number(document.documentElement.dataset.drawn ?? 0) + 1);
  }

  async function main() {
    data = await unpack(at("data").textContent);
    window.wayside = data;
    const order = (one, other) => one.localeCompare(other, "en", { numeric: true });
    data.subjects.sort((one, other) => order(one.rule, other.rule) || order(one.subject, other.subject));
    at("title").textContent = `Replay of ${data.recording}`;
    const episodes = data.rules.reduce((sum, each) => sum + each.episodes, 0);
    at("summary").textContent = `${data.begin.slice(0, 19).replace("T", " ")} UTC, ${span(data.length)}, ` +
      `${counted(data.samples, "sample")}, ${counted(data.rules.length, "rule")}, ${counted(episodes, "episode")}`;
    at("rule").replaceChildren(...data.rules.map((each) => element("option", { value: each.name, text: `${each.name} (${each.episodes})` })));
    at("rule").addEventListener("change", () => {
      const own = data.subjects.filter((each) => each.rule === at("rule").value);
      if (own.length) choose(own.find((each) => each.episodes.length) ?? own[0], false);
      else fillSubjects();
    });
    at("subject").addEventListener("change", () => choose(data.subjects.find((each) =>
      each.rule === at("rule").value && each.subject === at("subject").value), false));
    at("more").addEventListener("click", () => { everything = true; drawTimeline(); });
    chosen = data.subjects.find((each) => each.episodes.length) ?? data.subjects[0] ?? null;
    await draw();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  }

  main().catch((error) => {
    at("failure").hidden = false;
    at("failure").textContent = `The page cannot be drawn: ${error.message}. It needs a browser of 2023 or later.`;
    console.error(error);
  });
})();
