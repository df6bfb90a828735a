// Contact force of a canonical log, by the kernel in kernel.js (const KERNEL). Nothing is sent.
"use strict";

const AXES = ["x", "y", "z"];
const WRENCH = ["f", "tau"].flatMap((name) => AXES.map((axis) => `${name}_${axis}`));
const READING = [...WRENCH,
  ...["s", "omega", "alpha"].flatMap((name) => AXES.map((axis) => `${name}_${axis}`))];

/** Return the time and the 15 columns of a canonical log (CSV). */
function parseLog(text) {
  const lines = text.trim().split(/\r?\n/), names = lines[0].split(",").map((name) => name.trim());
  const missing = ["t", ...READING].filter((name) => !names.includes(name));
  if (missing.length) throw new Error(`the log has no column ${missing.join(", ")}`);
  const columns = ["t", ...READING].map((name) => names.indexOf(name));
  const rows = lines.slice(1).map((line) => {
    const cells = line.split(",");
    return columns.map((k) => (cells[k] ?? "").trim() === "" ? NaN : Number(cells[k]));
  });
  if (rows.length < 3) throw new Error("the log has fewer than 3 samples");
  return rows;
}

/** Return phi (10) and offsets (6) of an identification.json. */
function parseLoad(text) {
  const load = JSON.parse(text);
  for (const [name, size] of [["phi", 10], ["offsets", 6]]) {
    if (!Array.isArray(load[name]) || load[name].length !== size || !load[name].every(Number.isFinite))
      throw new Error(`the identification has no ${name} of ${size} numbers`);
  }
  if (load.weight_removed) throw new Error("the robot has removed the weight: use drake-teleop eliminate");
  if ((load.identifiable ?? []).slice(10).includes(false))
    throw new Error("the inertia is not identified: use drake-teleop eliminate");
  return [...load.phi, ...load.offsets];
}

/** Return the spacing of the samples, without gaps, as in drake_teleop. */
function spacing(t) {
  const steps = t.slice(1).map((value, k) => value - t[k]), sorted = [...steps].sort((a, b) => a - b);
  const half = sorted.length >> 1;
  const median = sorted.length % 2 ? sorted[half] : (sorted[half - 1] + sorted[half]) / 2;
  if (!(median > 0)) throw new Error("the times of the log do not increase");
  const regular = steps.filter((step) => step < 1.5 * median);
  return regular.reduce((sum, step) => sum + step, 0) / regular.length;
}

/** Return {t, measured, contact, flags}: wrenches (6 numbers a row), measured without offsets. */
async function compensate(logText, loadText, cutoffHz) {
  const rows = parseLog(logText), load = parseLoad(loadText), dt = spacing(rows.map((row) => row[0]));
  const bytes = Uint8Array.from(atob(KERNEL), (letter) => letter.charCodeAt(0));
  const { exports } = (await WebAssembly.instantiate(bytes)).instance;
  const array = (name, size) => new Float64Array(exports.memory.buffer, exports[name].value, size);
  const reading = array("reading", 18), result = array("result", 12);
  array("load", 16).set(load);
  const filtered = cutoffHz > 0 && cutoffHz < 0.5 / dt;
  exports.start(dt, filtered ? Math.tan(Math.PI * cutoffHz * dt) : 0, 0, 0, 1);
  const out = { t: [], measured: [], contact: [], flags: [] };
  for (const row of rows) {
    reading.set(row.slice(1));
    out.flags.push(exports.step());
    out.t.push(row[0]);
    out.measured.push(row.slice(1, 7).map((value, k) => value - load[10 + k]));
    out.contact.push(Array.from(result.subarray(0, 6)));
  }
  return out;
}

/** Draw measured and contact force of an axis into a canvas. */
function draw(canvas, found, axis) {
  const pen = canvas.getContext("2d"), { width, height } = canvas, { t } = found;
  const series = [["measured", "#888"], ["contact", "#d62728"]];
  const all = series.flatMap(([name]) => found[name].map((row) => row[axis])).filter(Number.isFinite);
  const low = all.reduce((a, b) => Math.min(a, b), 0), high = all.reduce((a, b) => Math.max(a, b), 0);
  const x = (time) => 50 + (width - 60) * (time - t[0]) / (t.at(-1) - t[0]);
  const y = (value) => height - 25 - (height - 35) * (value - low) / (high - low || 1);
  pen.clearRect(0, 0, width, height);
  pen.font = "13px sans-serif";
  pen.fillStyle = "#888";
  for (const value of [low, 0, high]) pen.fillText(`${value.toFixed(1)} N`, 2, y(value) + 4);
  pen.fillText(`${t[0].toFixed(1)} s`, 50, height - 5);
  pen.fillText(`${t.at(-1).toFixed(1)} s`, width - 45, height - 5);
  for (const [name, color] of series) {
    pen.strokeStyle = color;
    pen.beginPath();
    found[name].forEach((row, k) => pen[k ? "lineTo" : "moveTo"](x(t[k]), y(row[axis])));
    pen.stroke();
  }
}

/** Connect the elements of the page. */
function connect(page) {
  const part = (name) => page.querySelector(`[data-part=${name}]`);
  const said = part("said"), save = part("save");
  let log = "", found = null;
  async function update() {
    try {
      if (!log || !part("load").value.trim()) return;
      found = window.compensated = await compensate(log, part("load").value, Number(part("cutoff").value));
      const invalid = found.flags.filter((flag) => flag & ~1024).length;
      said.textContent = `${found.t.length} samples, ${invalid} of them invalid (contact force 0)`;
      const header = ["t", ...WRENCH.map((name) => `contact_${name}`), "flags"].join(",");
      const rows = found.t.map((t, k) => [t, ...found.contact[k], found.flags[k]].join(","));
      URL.revokeObjectURL(save.href);
      save.href = URL.createObjectURL(new Blob([[header, ...rows].join("\n") + "\n"]));
      draw(part("plot"), found, Number(part("axis").value));
    } catch (error) {
      said.textContent = `Error: ${error.message}`;
    }
  }
  async function take(files) {
    for (const file of files) {
      if (file.name.endsWith(".json")) part("load").value = await file.text();
      else log = await file.text();
    }
    await update();
  }
  page.addEventListener("dragover", (event) => event.preventDefault());
  page.addEventListener("drop", (event) => { event.preventDefault(); take(event.dataTransfer.files); });
  part("files").addEventListener("change", (event) => take(event.target.files));
  for (const name of ["load", "cutoff", "axis"]) part(name).addEventListener("change", update);
}

if (typeof document !== "undefined") connect(document.getElementById("compensate"));
