"use strict";
// Charts, switches and long tables of the page. All texts are set as text, never as markup.
(() => {
  const charts = JSON.parse(document.getElementById("data").textContent);
  const root = document.documentElement;
  const SUPERSCRIPT = "⁰¹²³⁴⁵⁶⁷⁸⁹";
  // Width of a chart on paper, where two are side by side.
  const PAPER = 345;
  let si = false, onPaper = false;

  function make(tag, attributes, ...children) {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes || {})) {
      if (name in element && name !== "list") element[name] = value;
      else element.setAttribute(name, value);
    }
    element.append(...children);
    return element;
  }

  function raised(power) {
    return "10" + (power < 0 ? "⁻" : "") + [...String(Math.abs(power))].map(d => SUPERSCRIPT[d]).join("");
  }

  // A number with three digits, e.g. 0.0123, 3,470 or 1.20×10⁻⁶, as the rest of the page has it.
  function number(v, digits = 3) {
    if (v == null || !isFinite(v)) return "–";
    if (v === 0) return "0";
    const size = Math.abs(v);
    if (size < 1e-3 || size >= 1e7) {
      const [mantissa, power] = v.toExponential(digits - 1).split("e");
      return `${mantissa.replace("-", "−")}×${raised(Number(power))}`;
    }
    const decimals = Math.max(digits - 1 - Math.floor(Math.log10(size)), 0);
    return v.toLocaleString("en", {minimumFractionDigits: Math.min(decimals, 9), maximumFractionDigits: Math.min(decimals, 9)}).replace("-", "−");
  }

  function tick(v) {
    if (v == null) return "";
    const power = Math.log10(Math.abs(v));
    if (v && (power < -3 || power >= 5)) {
      const whole = Math.floor(power + 1e-9), mantissa = Math.abs(v) / 10 ** whole;
      const factor = Math.abs(mantissa - 1) < 1e-6 ? "" : `${+mantissa.toPrecision(3)}·`;
      return (v < 0 ? "−" : "") + factor + raised(whole);
    }
    return String(+v.toPrecision(6)).replace("-", "−");
  }

  // Ticks of a logarithmic scale: powers of ten, with 2 and 5 between them where there are few.
  function decades(u, axis, min, max) {
    const first = Math.floor(Math.log10(min)), last = Math.ceil(Math.log10(max)), step = Math.ceil((last - first) / 9);
    const found = [];
    for (let power = first; power <= last; power += step) for (const factor of last - first > 3 ? [1] : [1, 2, 5]) found.push(+(factor * 10 ** power).toPrecision(3));
    const inside = found.filter(v => v >= min && v <= max);
    if (inside.length > 1) return inside;
    // Less than an octave: even steps.
    const gap = 10 ** Math.floor(Math.log10((max - min) / 2)), many = (max - min) / gap > 8 ? 5 : (max - min) / gap > 4 ? 2 : 1;
    return Array.from({length: 12}, (_, k) => +((Math.ceil(min / gap / many) + k) * gap * many).toPrecision(8)).filter(v => v <= max);
  }

  const css = name => getComputedStyle(root).getPropertyValue(name).trim();
  const colour = k => css(`--c${k % 6}`);
  // Text that is readable on a curve, too.
  const halo = (context, text, x, y) => {
    Object.assign(context, {strokeStyle: css("--paper"), lineWidth: 4 * uPlot.pxRatio, lineJoin: "round"});
    context.strokeText(text, x, y);
    context.fillText(text, x, y);
  };
  const faint = (c, alpha) => `color-mix(in srgb, ${c} ${100 * alpha}%, transparent)`;

  // --- One chart -------------------------------------------------------------------------------------------

  class Chart {
    constructor(figure, data) {
      this.figure = figure;
      this.data = data;
      this.plot = figure.querySelector(".plot");
      this.view = data.views[0];
      // The last of them is chosen, so at first the first one.
      this.shown = new Set([...this.view.groups.keys()].reverse());
      this.hidden = new Set(this.view.hidden);
      this.controls = make("div", {className: "controls", role: "group", "aria-label": `What ${data.title} shows`});
      this.readout = make("div", {className: "readout", "aria-live": "polite"});
      figure.insertBefore(this.controls, this.plot);
      this.whole = make("button", {type: "button", className: "tools", textContent: "Whole range", onclick: () => { this.zoom = null; this.draw(); }});
      figure.querySelector("figcaption").append(this.whole, make("button", {type: "button", className: "copy", textContent: "Copy CSV", onclick: event => copy(event.target, this.csv())}));
      figure.append(this.readout);
      if (data.slider) this.addSlider();
      this.plot.addEventListener("keydown", event => this.key(event));
      this.fillControls();
    }

    get chosen() {
      return [...this.shown].at(-1);
    }

    fillControls() {
      const button = (text, pressed, act, kind) => make("button", {type: "button", className: kind || "", textContent: text, "aria-pressed": String(pressed), onclick: act});
      const {views} = this.data, {groups, traces, marks, spans, single} = this.view;
      this.controls.replaceChildren();
      if (views.length > 1) for (const view of views) {
        this.controls.append(button(view.name, view === this.view, () => { this.view = view; this.zoom = null; this.hidden = new Set(view.hidden); this.update(); }, "view"));
      }
      if (groups.length > 1) groups.forEach((name, k) => {
        const b = button(name, this.shown.has(k), () => { this.toggle(this.shown, k); }, "group");
        b.style.color = colour(k);
        this.controls.append(b);
      });
      const layers = [...new Set(traces.map(t => t.layer)), ...(marks.length || spans.length ? ["marks"] : [])];
      if (layers.length > 1) for (const layer of layers) {
        const b = button(layer, !this.hidden.has(layer), () => { this.toggle(this.hidden, layer); }, "layer");
        b.dataset.look = traces.find(t => t.layer === layer)?.look || "marks";
        if (single && layer === "marks" && this.shown.size) Object.assign(b, {title: `of ${groups[this.chosen]}`}).style.color = colour(this.chosen);
        this.controls.append(b);
      }
    }

    toggle(set, item) {
      if (!set.delete(item)) set.add(item);
      this.update();
    }

    // Redraw, with the focus on the control that had it.
    update() {
      const text = this.controls.contains(document.activeElement) ? document.activeElement.textContent : null;
      this.fillControls();
      if (text) [...this.controls.children].find(b => b.textContent === text)?.focus();
      this.draw();
    }

    traces() {
      return this.view.traces.filter(t => this.shown.has(t.group) && !this.hidden.has(t.layer));
    }

    unit() {
      return this.view.units[si ? this.view.units.length - 1 : 0];
    }

    draw() {
      const view = this.view, [unit, size] = this.unit(), width = onPaper ? PAPER : Math.max(this.plot.clientWidth, 240);
      const logs = {x: view.log.includes("x"), y: view.log.includes("y")};
      const safe = v => v == null || (logs.y && v <= 0) ? null : v / size;
      const tables = [], series = [{}], bands = [];
      this.drawn = this.traces();
      this.whole.hidden = !this.zoom;
      for (const trace of this.drawn) {
        const c = colour(trace.group), rings = trace.look === "rings", dots = rings || trace.look === "dots";
        const table = [trace.x, trace.y.map(safe)];
        const line = {stroke: c, width: dots ? 0 : trace.look === "line" ? 1.6 : 1, spanGaps: true, dash: trace.look === "dashes" ? [5, 4] : [], points: {show: dots, size: rings ? 9 : 5, fill: rings ? "transparent" : c, stroke: c}};
        if (dots) line.paths = () => null;
        trace.index = series.length;
        series.push(line);
        if (trace.low) {
          table.push(trace.high.map(safe), trace.low.map(safe));
          const end = {stroke: "transparent", width: 0, spanGaps: true, points: {show: false}};
          bands.push({series: [series.length, series.length + 1], fill: faint(c, 0.22)});
          series.push(end, {...end});
        }
        tables.push(table);
      }
      const data = tables.length ? uPlot.join(tables) : [[1, 10]];
      const ink = css("--ink"), grid = {stroke: css("--line"), width: 1}, font = "12px system-ui, sans-serif";
      const range = log => (u, min, max) => min == null ? (log ? [1, 10] : [0, 1]) : log ? [min / 1.25, max * 1.25] : [min - 0.04 * (max - min || 1), max + 0.04 * (max - min || 1)];
      // Marks within a factor of thirty of the curves are on the chart.
      const marked = this.marks().filter(m => m.y != null).map(m => m.y / size);
      const near = (u, min, max) => range(logs.y)(u, ...(min == null ? [min, max] : [Math.min(min, ...marked.filter(y => y > min / 30)), Math.max(max, ...marked.filter(y => y < max * 30))]));
      const axis = (label, log, more) => ({label, stroke: ink, grid, ticks: grid, font, labelFont: font, labelSize: 20, ...(log ? {splits: decades, filter: (u, v) => v} : {}), values: (u, splits) => splits.map(tick), ...more});
      this.chart?.destroy();
      this.chart = new uPlot({
        width, height: onPaper ? 0.6 * PAPER : Math.max(260, Math.min(440, 0.5 * width)), pxAlign: 0,
        scales: {x: {time: false, distr: logs.x ? 3 : 1, range: range(logs.x)}, y: {distr: logs.y ? 3 : 1, range: near}},
        axes: [axis(`${view.x} [${view.x_unit}]`, logs.x, {size: 32}), axis(unit ? `${view.y} [${unit}]` : view.y, logs.y, {size: 62})],
        series, bands, legend: {show: false},
        cursor: {drag: {x: true, y: true, uni: 40}, points: {show: false}},
        hooks: {setCursor: [u => this.hover(u)], draw: [u => this.annotate(u)], setSelect: [u => this.selected(u)], drawClear: [u => this.shade(u)]},
      }, data, this.plot);
      if (this.zoom) this.apply(this.zoom);
    }

    selected(u) {
      const {left, top, width, height} = u.select;
      if (width < 3 || height < 3) return;
      this.whole.hidden = false;
      this.zoom = {x: [u.posToVal(left, "x"), u.posToVal(left + width, "x")], y: [u.posToVal(top + height, "y"), u.posToVal(top, "y")], unit: this.unit()[1]};
    }

    apply(zoom) {
      this.whole.hidden = false;
      const scale = zoom.unit / this.unit()[1];
      this.chart.setScale("x", {min: zoom.x[0], max: zoom.x[1]});
      if (zoom.y) this.chart.setScale("y", {min: zoom.y[0] * scale, max: zoom.y[1] * scale});
    }

    // --- Reading --------------------------------------------------------------------------------------------

    hover(u) {
      if (u.cursor.left >= 0) this.read(u.posToVal(u.cursor.left, "x"));
    }

    // Values of all traces at the point that is nearest to x.
    read(x) {
      const view = this.view, [unit, size] = this.unit(), log = view.log.includes("x");
      const distance = v => Math.abs(log ? Math.log(v / x) : v - x);
      const nearest = t => t.x.reduce((best, v, k) => distance(v) < distance(t.x[best]) ? k : best, 0);
      const first = this.drawn.find(t => t.look === "dots" && t.x.length) || this.drawn.find(t => t.x.length);
      if (!first) return;
      const at = first.x[nearest(first)];
      const lines = [make("div", {}, `${view.x} = ${number(at, 4)} ${view.x_unit}`)];
      for (const group of [...this.shown].sort()) {
        const own = this.drawn.filter(t => t.group === group && t.layer !== "terms" && t.x.length);
        own.sort((a, b) => (b.look === "dots") - (a.look === "dots"));
        if (!own.length) continue;
        const texts = own.map(t => {
          const k = nearest(t);
          let text = `${own.length > 1 || t.layer !== "measured" ? t.layer + " " : ""}${number(t.y[k] == null ? null : t.y[k] / size)} ${unit}`;
          if (t.low && t.low[k] != null) text += ` (${view.interval}: ${number(t.low[k] / size)} … ${number(t.high[k] / size)})`;
          if (t.names.length) text += `, ${t.names[t.labels[k]]}`;
          return text;
        });
        const name = make("b", {textContent: "●\u00a0"});
        name.style.color = colour(group);
        lines.push(make("div", {}, name, `${view.groups[group]}: ${texts.join("; ")}`));
      }
      this.readout.replaceChildren(...lines);
      if (this.slider && document.activeElement !== this.slider) this.slider.value = this.steps().indexOf(at);
      this.at = at;
    }

    steps() {
      const main = this.view.traces.find(t => t.look === "dots") || this.view.traces[0];
      return main ? main.x : [];
    }

    // Move the cursor to x.
    go(x) {
      const u = this.chart;
      u.setCursor({left: u.valToPos(x, "x"), top: u.bbox.height / uPlot.pxRatio / 2});
      this.read(x);
    }

    key(event) {
      const steps = this.steps(), u = this.chart;
      if (!u || !steps.length) return;
      const k = steps.indexOf(this.at), keys = {ArrowRight: 1, ArrowLeft: -1, PageUp: 10, PageDown: -10, Home: -1e9, End: 1e9};
      if (event.key in keys) {
        this.go(steps[Math.min(Math.max((k < 0 ? 0 : k) + keys[event.key], 0), steps.length - 1)]);
      } else if (event.key === "+" || event.key === "-") {
        const log = this.view.log.includes("x"), to = log ? Math.log : v => v, from = log ? Math.exp : v => v;
        const [min, max] = [to(u.scales.x.min), to(u.scales.x.max)], middle = this.at == null ? (min + max) / 2 : to(this.at);
        const half = (max - min) / 2 * (event.key === "+" ? 0.6 : 1 / 0.6);
        this.zoom = {x: [from(middle - half), from(middle + half)], unit: this.unit()[1]};
        this.apply(this.zoom);
      } else if (event.key === "0" || event.key === "Escape") {
        this.zoom = null;
        this.draw();
      } else return;
      event.preventDefault();
    }

    addSlider() {
      const steps = this.steps();
      this.slider = make("input", {type: "range", min: 0, max: steps.length - 1, value: Math.round(0.7 * steps.length), oninput: () => this.go(this.steps()[this.slider.value])});
      this.figure.append(make("label", {className: "slider"}, `${this.data.slider} `, this.slider));
    }

    // --- Marks ----------------------------------------------------------------------------------------------

    // Spans are shaded where they are narrow.
    shade(u) {
      const context = u.ctx, {left, top, width, height} = u.bbox;
      context.save();
      context.beginPath();
      context.rect(left, top, width, height);
      context.clip();
      context.fillStyle = faint(css("--care"), 0.13);
      for (const span of this.spans()) {
        const a = u.valToPos(span.start, "x", true), b = u.valToPos(span.stop, "x", true);
        if (b - a < 0.3 * width) context.fillRect(a, top, Math.max(b - a, 2 * uPlot.pxRatio), height);
      }
      context.restore();
    }

    marks() {
      const {marks, single} = this.view;
      return this.hidden.has("marks") ? [] : marks.filter(m => m.group == null || (single ? m.group === this.chosen : this.shown.has(m.group)));
    }

    spans() {
      return this.hidden.has("marks") ? [] : this.view.spans.filter(span => span.group == null || this.shown.has(span.group));
    }

    // Spans as named bars, one above another where they overlap; returns where their names are.
    bars(u) {
      const context = u.ctx, ratio = uPlot.pxRatio, {left, top, width, height} = u.bbox, ends = [], taken = [];
      context.fillStyle = css("--care");
      for (const span of this.spans()) {
        const a = Math.max(u.valToPos(span.start, "x", true), left), b = Math.min(u.valToPos(span.stop, "x", true), left + width);
        if (b < left || a > left + width) continue;
        const w = context.measureText(span.text).width, x = Math.min(a, left + width - w - 3 * ratio);
        let row = ends.findIndex(end => end < x);
        if (row < 0) row = ends.length;
        ends[row] = Math.max(b, x + w) + 6 * ratio;
        const y = top + height - (5 + 15 * row) * ratio;
        if (y < top + 0.4 * height) continue;
        context.fillRect(a, y, Math.max(b - a, 2 * ratio), 2.5 * ratio);
        halo(context, span.text, x, y - 3 * ratio);
        taken.push([x, x + w, y - 16 * ratio, y]);
      }
      return taken;
    }

    annotate(u) {
      const context = u.ctx, ratio = uPlot.pxRatio, {left, top, width, height} = u.bbox, size = this.unit()[1];
      context.save();
      context.beginPath();
      context.rect(left, top, width, height);
      context.clip();
      context.font = `${11 * ratio}px system-ui, sans-serif`;
      context.textAlign = "left";
      context.textBaseline = "alphabetic";
      const taken = this.bars(u);
      // Texts are left out where they would cover one another.
      const write = (text, x, y) => {
        const w = context.measureText(text).width, h = 13 * ratio;
        for (let k = 0; k < 8; k++) {
          const row = y + (k % 2 ? 1 : -1) * Math.ceil(k / 2) * h;
          const start = Math.min(x, left + width - w - 2 * ratio);
          if (row < top + h || row > top + height - 3 * ratio) continue;
          if (taken.some(([a, b, c, d]) => start < b && start + w > a && row - h < d && row > c)) continue;
          taken.push([start, start + w, row - h, row]);
          halo(context, text, start, row);
          return;
        }
      };
      for (const mark of this.marks()) {
        const x = u.valToPos(mark.x, "x", true), ink = mark.group == null ? css("--ink") : colour(mark.group);
        if (x < left || x > left + width) continue;
        context.strokeStyle = context.fillStyle = ink;
        context.lineWidth = ratio;
        if (mark.y == null) {
          context.setLineDash([2 * ratio, 4 * ratio]);
          context.strokeRect(x, top, 0, height);
          context.setLineDash([]);
          write(mark.text, x + 3 * ratio, top + 14 * ratio);
        } else {
          const y = u.valToPos(mark.y / size, "y", true);
          if (y < top || y > top + height) continue;
          context.beginPath();
          context.arc(x, y, 5 * ratio, 0, 2 * Math.PI);
          context.stroke();
          write(mark.text, x + 8 * ratio, y - 4 * ratio);
        }
      }
      context.restore();
    }

    csv() {
      const [unit, size] = this.unit(), quote = text => `"${String(text).replace(/"/g, '""')}"`;
      const rows = [["group", "layer", `${this.view.x} [${this.view.x_unit}]`, `${this.view.y} [${unit}]`, "low", "high"].map(quote).join(",")];
      const cell = v => v == null ? "" : +(v / size).toPrecision(6);
      for (const t of this.traces()) t.x.forEach((x, k) => rows.push([quote(this.view.groups[t.group]), quote(t.layer), x, cell(t.y[k]), t.low ? cell(t.low[k]) : "", t.high ? cell(t.high[k]) : ""].join(",")));
      return rows.join("\n");
    }
  }

  // --- Long tables -------------------------------------------------------------------------------------------

  class Units {
    constructor(element, {heads, rows, marked}) {
      Object.assign(this, {rows: rows.map((cells, k) => ({cells, k})), marked: new Set(marked), most: 100, order: null});
      this.filter = make("input", {type: "search", placeholder: "part of a name", "aria-label": "Filter the rows", oninput: () => this.fill()});
      this.only = make("button", {type: "button", textContent: "Only marked", "aria-pressed": "false", onclick: () => { this.only.setAttribute("aria-pressed", String(this.only.getAttribute("aria-pressed") !== "true")); this.fill(); }});
      this.body = make("tbody");
      this.count = make("p", {className: "note", "aria-live": "polite"});
      this.more = make("button", {type: "button", textContent: "More rows", onclick: () => { this.most += 100; this.fill(); }});
      const head = make("tr", {}, ...heads.map((text, j) => make("th", {scope: "col"}, make("button", {type: "button", textContent: text, onclick: () => this.sort(j)}))));
      element.append(make("div", {className: "controls"}, this.filter, this.only), make("div", {className: "wide"}, make("table", {}, make("thead", {}, head), this.body)), this.count, this.more);
      this.fill();
    }

    sort(j) {
      const key = row => Array.isArray(row.cells[j]) ? row.cells[j][0] : row.cells[j];
      const up = this.order === j ? -1 : 1;
      this.order = up > 0 ? j : null;
      this.rows.sort((a, b) => {
        const [x, y] = [key(a), key(b)];
        if (x == null || y == null) return (x == null) - (y == null);
        return up * (typeof x === "number" && typeof y === "number" ? x - y : String(x).localeCompare(String(y), "en", {numeric: true}));
      });
      this.fill();
    }

    fill() {
      const text = this.filter.value.toLowerCase(), only = this.only.getAttribute("aria-pressed") === "true";
      const cell = v => typeof v === "number" ? number(v) : v == null ? "–" : v;
      const found = this.rows.filter(row => (!only || this.marked.has(row.k)) && (!text || row.cells.some(c => String(c).toLowerCase().includes(text))));
      this.body.replaceChildren(...found.slice(0, this.most).map(({cells, k}) => make("tr", {className: this.marked.has(k) ? "marked" : ""}, ...cells.map(c => Array.isArray(c) ? make("td", {}, make("a", {href: c[1], rel: "noopener", textContent: c[0]})) : make("td", {textContent: cell(c)})))));
      this.count.textContent = `${Math.min(found.length, this.most)} of ${found.length} rows`;
      this.more.hidden = found.length <= this.most;
    }
  }

  // --- The page ----------------------------------------------------------------------------------------------

  function copy(button, text) {
    const said = button.textContent, say = word => { button.textContent = word; setTimeout(() => { button.textContent = said; }, 1200); };
    const area = make("textarea", {value: text});
    document.body.append(area);
    area.select();
    const done = document.execCommand("copy");
    area.remove();
    button.focus();
    if (done) say("Copied");
    else navigator.clipboard?.writeText(text).then(() => say("Copied"), () => say("Select and copy by hand"));
  }

  const made = new Map();
  const figures = [...document.querySelectorAll(".chart")];
  function draw(figure) {
    if (!made.has(figure)) made.set(figure, new Chart(figure, charts[figure.dataset.chart]));
    made.get(figure).draw();
  }
  // Charts are drawn when they are about to be seen.
  const near = new IntersectionObserver(entries => entries.forEach(({isIntersecting, target}) => { if (isIntersecting && !made.has(target)) draw(target); }), {rootMargin: "600px"});
  figures.forEach(figure => near.observe(figure));
  for (const element of document.querySelectorAll(".units")) new Units(element, charts[element.dataset.chart]);

  const redraw = () => made.forEach(chart => chart.draw());
  const dark = matchMedia("(prefers-color-scheme: dark)");
  function setTheme(isDark) {
    root.dataset.theme = isDark ? "dark" : "light";
    document.getElementById("theme").setAttribute("aria-pressed", String(isDark));
    made.forEach(chart => chart.update());
  }
  setTheme(dark.matches);
  dark.addEventListener("change", event => setTheme(event.matches));
  document.getElementById("theme").onclick = () => setTheme(root.dataset.theme !== "dark");
  document.getElementById("units").onclick = event => {
    si = !si;
    root.toggleAttribute("data-si", si);
    event.target.setAttribute("aria-pressed", String(si));
    redraw();
    made.forEach(chart => chart.at != null && chart.read(chart.at));
  };
  for (const element of document.querySelectorAll(".exports")) {
    const texts = [...element.querySelectorAll("pre")], choice = element.querySelector("select");
    choice.onchange = () => texts.forEach((pre, k) => { pre.hidden = k !== choice.selectedIndex; });
    element.querySelector(".copy").onclick = event => copy(event.target, texts[choice.selectedIndex].textContent);
  }
  let resized;
  addEventListener("resize", () => { clearTimeout(resized); resized = setTimeout(redraw, 150); });
  // On paper charts are small, and on white.
  addEventListener("beforeprint", () => {
    onPaper = true;
    setTheme(false);
    figures.forEach(draw);
  });
  addEventListener("afterprint", () => {
    onPaper = false;
    setTheme(dark.matches);
  });
})();
