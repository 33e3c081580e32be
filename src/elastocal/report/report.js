// The pages' only script.  Without it everything but the turning 3-D view is there to be read.
"use strict";

// A number stays on the line of its unit.

for (const element of document.querySelectorAll("p, dd, li, figcaption")) {
  for (const node of element.childNodes) {
    if (node.nodeType !== Node.TEXT_NODE) continue;
    const units = /(?<=\d) (?=([µm]?m|µ?rad|mrad|%|N|s|h|min|ppm)(?![\w/]))|(?<=[≤<±]) (?=\d)/g;
    node.data = node.data.replace(units, "\u00a0");
  }
}

// Tables: sorted by a click on a head, and saved as CSV.

const LENGTHS = { "nm": 1e-9, "µm": 1e-6, "mm": 1e-3, "m": 1 };

/** What a cell is sorted by: the number it begins with, in metres where it is a length; or text. */
function sortKey(text) {
  const plain = text.trim().replaceAll("−", "-").replace(/^[±<>≈[\s]+/, "");
  const found = /^([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*(nm|µm|mm|m)?(?![\wµ])/i.exec(plain);
  if (found) return { number: Number(found[1]) * (LENGTHS[found[2]] ?? 1), text: plain };
  return { number: NaN, text: plain };
}

/** Numbers by size, then words by alphabet; what is empty or "–" stands last either way. */
function compare(a, b, direction) {
  const empty = key => key.text === "" || key.text === "–";
  if (empty(a) || empty(b)) return empty(a) - empty(b);
  const words = isNaN(a.number) - isNaN(b.number);
  if (words) return words;
  const order = isNaN(a.number)
    ? a.text.localeCompare(b.text, "en", { numeric: true })
    : a.number - b.number;
  return direction * order;
}

const NEXT = { none: "ascending", ascending: "descending", descending: "none" };

function sortBy(table, head) {
  const body = table.tBodies[0];
  const direction = NEXT[head.getAttribute("aria-sort") ?? "none"];
  for (const other of table.tHead.rows[0].cells) {
    if (other.hasAttribute("aria-sort")) other.setAttribute("aria-sort", "none");
  }
  head.setAttribute("aria-sort", direction);
  const rows = table.initial.filter(row => direction === "none" || !row.matches(".group"));
  if (direction !== "none") {
    const sign = direction === "ascending" ? 1 : -1;
    const keyed = rows.map(row => [sortKey(row.cells[head.cellIndex].textContent), row]);
    keyed.sort((a, b) => compare(a[0], b[0], sign));
    body.replaceChildren(...keyed.map(pair => pair[1]));
  } else {
    body.replaceChildren(...rows);
  }
}

/** A cell for CSV: numbers with a plain minus; a name that a spreadsheet would compute is quoted. */
function csvCell(text) {
  let cell = text.trim().replace(/\s+/g, " ");
  if (/^−[\d.]/.test(cell)) cell = "-" + cell.slice(1);
  if (/^[=@\t\r]|^[+-](?![\d.])/.test(cell)) cell = "'" + cell;
  return /[",\n\r]/.test(cell) ? '"' + cell.replaceAll('"', '""') + '"' : cell;
}

function csvOf(table) {
  const heads = [...table.tHead.rows[0].cells];
  const line = row => heads.map(head => csvCell(row.cells[head.cellIndex].textContent)).join(",");
  const rows = [...table.tBodies[0].rows].filter(row => !row.matches(".group"));
  return [table.tHead.rows[0], ...rows].map(line).join("\r\n") + "\r\n";
}

function prepareTable(table) {
  table.initial = [...table.tBodies[0].rows];
  for (const head of table.tHead.rows[0].cells) {
    head.setAttribute("aria-sort", "none");
    const button = document.createElement("button");
    button.type = "button";
    button.className = "sort";
    button.append(...head.childNodes);
    button.addEventListener("click", () => sortBy(table, head));
    head.append(button);
  }
  const save = document.createElement("a");
  save.className = "csv";
  save.textContent = "CSV";
  save.download = `${table.dataset.name}.csv`;
  save.href = "#";
  save.setAttribute("aria-label", `Save the table ${table.dataset.name} as CSV`);
  // Made when it is asked for, so that the order is the one shown.
  save.addEventListener("click", () => {
    if (save.href.startsWith("blob:")) URL.revokeObjectURL(save.href);
    save.href = URL.createObjectURL(new Blob(["\ufeff" + csvOf(table)], { type: "text/csv" }));
  });
  table.after(save);
}

// The 3-D view.

const AXES = ["x", "y", "z"];

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** Points (flat) through a 3 × 4 transform given row by row. */
function moved(points, T) {
  const out = [[], [], []];
  for (let k = 0; k < points.length; k += 3) {
    for (let r = 0; r < 3; r++) {
      const [a, b, c, d] = T.slice(4 * r, 4 * r + 4);
      out[r].push(a * points[k] + b * points[k + 1] + c * points[k + 2] + d);
    }
  }
  return out;
}

/** One mesh of several bodies, each moved by its carrier's transform. */
function mesh(bodies, transforms) {
  const all = { x: [], y: [], z: [], i: [], j: [], k: [] };
  for (const body of bodies) {
    const start = all.x.length;
    const placed = moved(body.points, transforms[body.carrier]);
    AXES.forEach((axis, r) => { for (const v of placed[r]) all[axis].push(v); });
    body.faces.forEach((corner, n) => all["ijk"[n % 3]].push(start + corner));
  }
  return all;
}

/** Lines (x, y, z) with gaps, from a list of pieces, each a list of points. */
function lines(pieces) {
  const all = { x: [], y: [], z: [] };
  for (const piece of pieces) {
    for (const point of piece) AXES.forEach((axis, r) => all[axis].push(point[r]));
    AXES.forEach(axis => all[axis].push(null));
  }
  return all;
}

const add = (a, b, factor = 1) => a.map((v, r) => v + factor * b[r]);
const norm = v => Math.hypot(...v);

/** Plotly takes what it is given to show for markup. */
const asText = name => name.replaceAll("&", "&amp;").replaceAll("<", "&lt;");

/** A shaft with two barbs, so that it reads as an arrow from every side. */
function arrow(from, step) {
  const tip = add(from, step), size = norm(step);
  if (!(size > 0)) return [[from, from]];
  const away = Math.abs(step[2]) < 0.9 * size ? [0, 0, 1] : [1, 0, 0];
  const side = [step[1] * away[2] - step[2] * away[1], step[2] * away[0] - step[0] * away[2],
    step[0] * away[1] - step[1] * away[0]];
  const barb = sign => add(add(tip, step, -0.25), side, sign * 0.12 * size / norm(side));
  return [[from, tip], [barb(1), tip, barb(-1)]];
}

class View {
  constructor(figure) {
    this.figure = figure;
    this.data = JSON.parse(figure.querySelector(".view-data").textContent);
    this.live = figure.querySelector(".live");
    this.pose = this.data.first;
    this.scale = this.data.scale;
    this.everywhere = false;
  }

  traces() {
    const d = this.data, pose = d.poses[this.pose];
    const flat = { flatshading: false, hoverinfo: "skip", lighting: { ambient: 0.65, diffuse: 0.6 } };
    const still = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];
    const found = [{
      type: "mesh3d", name: "arm", ...mesh(d.bodies, pose.frames), ...flat,
      color: colour("arm"), showlegend: true,
    }];
    if (d.things.length) {
      found.push({ type: "mesh3d", name: "obstacles", ...mesh(d.things, [still]), ...flat,
        color: colour("faint"), opacity: 0.35, showlegend: true });
    }
    const others = d.poses.filter((_, n) => n !== this.pose);
    if (others.length) {
      found.push({ type: "scatter3d", mode: "lines", name: "other poses",
        ...lines(others.map(p => p.line)), line: { color: colour("series1"), width: 3 },
        opacity: 0.45, hoverinfo: "skip", visible: d.arrows ? "legendonly" : true });
    }
    if (!d.arrows) {
      found.push({ type: "scatter3d", mode: "markers+text", name: "flange, by pose",
        ...lines([d.poses.map(p => p.line.at(-1))]), text: d.poses.map(p => asText(p.name)),
        textposition: "top center", textfont: { color: colour("ink"), size: 12 },
        marker: { color: colour("series1"), size: 3.5 }, hoverinfo: "skip" });
    }
    found.push({ type: "scatter3d", mode: "lines", name: "markers to flange",
      ...lines(pose.markers.map(m => [pose.line.at(-1), m])), hoverinfo: "skip",
      line: { color: colour("ink"), width: 2 }, showlegend: false });
    found.push({ type: "scatter3d", mode: "markers", name: "markers",
      ...lines([pose.markers]), text: pose.names.map(asText), hovertemplate: "%{text}<extra></extra>",
      marker: { color: colour("ink"), size: 3.5, symbol: "circle" } });
    if (d.arrows) {
      const shown = this.everywhere ? d.poses : [pose];
      const pieces = shown.flatMap(p =>
        p.arrows.flatMap((a, m) => arrow(p.markers[m], a.map(v => v * 1e-6 * this.scale))));
      found.push({ type: "scatter3d", mode: "lines", name: "residuals", ...lines(pieces),
        line: { color: colour("series2"), width: 5 }, hoverinfo: "skip" });
    }
    if (d.tracker) {
      found.push({ type: "scatter3d", mode: "markers", name: "tracker", ...lines([[d.tracker]]),
        marker: { color: colour("series3"), size: 7, symbol: "diamond" },
        hovertemplate: "tracker<extra></extra>" });
    }
    return found;
  }

  /** Edges of the box over its longest, so that all of it is seen from the camera's place. */
  shape() {
    const edges = this.data.range.map(([low, high]) => high - low);
    const longest = Math.max(...edges);
    return Object.fromEntries(AXES.map((axis, r) => [axis, edges[r] / longest]));
  }

  layout() {
    const axis = name => ({ title: { text: `${name} in m` }, color: colour("ink"),
      gridcolor: colour("line"), zerolinecolor: colour("line"), showbackground: false,
      range: this.data.range[AXES.indexOf(name)], autorange: false });
    return {
      scene: { xaxis: axis("x"), yaxis: axis("y"), zaxis: axis("z"), aspectmode: "manual",
        aspectratio: this.shape(), camera: this.camera ?? { eye: { x: 1.15, y: -1.45, z: 0.65 } }, uirevision: "kept" },
      paper_bgcolor: "rgba(0,0,0,0)", font: { color: colour("ink"), size: 12 },
      margin: { l: 0, r: 0, t: 0, b: 0 }, uirevision: "kept",
      legend: { orientation: "h", y: 0, x: 0, bgcolor: "rgba(0,0,0,0)" },
    };
  }

  draw() {
    this.told.textContent = this.words().replace(/(^|\s)-(?=\d)/g, "$1−");
    return Plotly.react(this.plot, this.traces(), this.layout(),
      { responsive: true, displaylogo: false, scrollZoom: true,
        modeBarButtons: [["zoom3d", "pan3d", "tableRotation", "resetCameraDefault3d"]] });
  }

  words() {
    const d = this.data, pose = d.poses[this.pose];
    const parts = [pose.about];
    if (d.arrows) parts.push(`arrows drawn ${this.scale} times as long as the residuals`);
    return parts.filter(Boolean).join("; ");
  }

  /** Controls with labels, for keyboard and screen reader. */
  controls() {
    const bar = document.createElement("div");
    bar.className = "controls";
    const label = text => {
      const element = document.createElement("label");
      element.append(text);
      bar.append(element);
      return element;
    };
    const choice = document.createElement("select");
    choice.className = "pose";
    this.data.poses.forEach((pose, n) => choice.append(new Option(pose.name, n)));
    choice.value = this.pose;
    choice.addEventListener("change", () => { this.pose = Number(choice.value); this.draw(); });
    label(`${this.data.what} `).append(choice);
    if (this.data.arrows) {
      const scale = document.createElement("select");
      scale.className = "scale";
      for (const factor of [0.2, 0.5, 1, 2, 5]) {
        const value = Number((this.data.scale * factor).toPrecision(2));
        scale.append(new Option(`${value} ×`, value));
      }
      scale.value = this.scale;
      scale.addEventListener("change", () => { this.scale = Number(scale.value); this.draw(); });
      label("arrows ").append(scale);
      const all = document.createElement("input");
      all.type = "checkbox";
      all.addEventListener("change", () => { this.everywhere = all.checked; this.draw(); });
      label("").append(all, " of all poses");
    }
    this.told = document.createElement("output");
    bar.append(this.told);
    return bar;
  }

  async show() {
    this.plot = document.createElement("div");
    this.plot.className = "plot";
    this.live.append(this.controls(), this.plot);
    this.live.hidden = false;
    await this.draw();
    // The wheel scrolls the page; with Ctrl it zooms.
    this.plot.addEventListener("wheel", event => {
      if (!event.ctrlKey) event.stopPropagation();
    }, { capture: true });
    // Where it was turned to stays, whatever is drawn next.
    this.plot.on("plotly_relayout", change => {
      this.camera = change["scene.camera"] ?? this.camera;
    });
    this.figure.classList.add("drawn");
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }
}

function drawsInSpace() {
  const canvas = document.createElement("canvas");
  const context = canvas.getContext("webgl2") ?? canvas.getContext("webgl");
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return Boolean(context);
}

/** plotly.js, which the page carries packed. */
async function loadPlotly() {
  if (window.Plotly) return;
  const packed = atob(document.getElementById("plotly").textContent);
  const bytes = Uint8Array.from(packed, letter => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(stream).text();
  document.head.append(script);
}

/** Draw a view, when the fold that it stands in is opened: what is hidden has no size. */
async function showView(figure) {
  const fold = figure.closest("details");
  if (fold && !fold.open) {
    fold.addEventListener("toggle", () => showView(figure), { once: true });
    return;
  }
  await loadPlotly();
  await new View(figure).show();
}

async function showViews() {
  // The still picture stays where the browser cannot do better.
  if (typeof DecompressionStream === "undefined" || !drawsInSpace()) return;
  for (const figure of document.querySelectorAll("figure.view")) await showView(figure);
}

document.querySelectorAll("table.data").forEach(prepareTable);
showViews().finally(() => document.documentElement.classList.add("ready"));
