// The map over time: what one step shows, and the controls that choose the step.
'use strict';

const map = document.getElementById('map');
const slider = document.getElementById('step');
const steps = columns.time.length;
const SOURCES = data.sources; // names and colours of what a path may be taken for
const ARC = Array.from({length: 33}, (_, i) => [Math.cos(i * Math.PI / 16), Math.sin(i * Math.PI / 16)]);
const VA = 1, SP = 2, CLUTTER = SOURCES.length - 1;

let shown = -1;
let magnified = data.magnified;

// --- the pieces of a step ------------------------------------------------------------------------

// The outline of an ellipse: centre and the Cholesky factor of the covariance, grown by `scale`.
function addEllipse(line, x, y, xx, xy, yy, scale) {
  const a = Math.sqrt(Math.max(xx, 0)), b = a > 0 ? xy / a : 0;
  const c = Math.sqrt(Math.max(yy - b * b, 0));
  for (const [u, v] of ARC) {
    line.x.push(x + scale * a * u);
    line.y.push(y + scale * (b * u + c * v));
  }
  line.x.push(null);
  line.y.push(null);
}

function newLine() { return {x: [], y: []}; }

function vehicleEllipse(k) {
  const line = newLine();
  const c = columns;
  addEllipse(line, c.x[k], c.y[k], c.pxx[k], c.pxy[k], c.pyy[k], data.deviations * magnified);
  return line;
}

function landmarksAt(k, type) {
  const c = columns, found = {x: [], y: [], opacity: [], symbol: [], info: [], outline: newLine()};
  const filled = type === VA ? 'square' : 'circle';
  for (let i = c.landmark_start[k]; i < c.landmark_start[k + 1]; i++) {
    if (c.landmark_type[i] !== type) continue;
    const x = c.landmark_x[i], y = c.landmark_y[i];
    found.x.push(x);
    found.y.push(y);
    found.opacity.push(0.15 + 0.85 * c.landmark_existence[i]);
    found.symbol.push(c.landmark_reported[i] ? filled : `${filled}-open`);
    found.info.push([c.landmark_id[i], c.landmark_existence[i], c.landmark_sigma[i],
      c.landmark_z[i]]);
    if (c.landmark_reported[i]) {
      addEllipse(found.outline, x, y, c.landmark_pxx[i], c.landmark_pxy[i], c.landmark_pyy[i],
        data.deviations * magnified);
    }
  }
  return found;
}

function raysAt(k) {
  const c = columns, rays = SOURCES.map(newLine);
  for (let i = c.path_start[k]; i < c.path_start[k + 1]; i++) {
    const source = c.path_source[i], ray = rays[source];
    ray.x.push(c.x[k], c.path_x[i]);
    ray.y.push(c.y[k], c.path_y[i]);
    if (source !== CLUTTER) {
      ray.x.push(data.bs[0]);
      ray.y.push(data.bs[1]);
    }
    ray.x.push(null);
    ray.y.push(null);
  }
  return rays;
}

// --- traces --------------------------------------------------------------------------------------

function hover(name) {
  return `${name} %{customdata[0]}<br>existence %{customdata[1]:.3f}` +
    '<br>sigma %{customdata[2]:.2f} m<br>x %{x:.2f}, y %{y:.2f}, z %{customdata[3]:.2f} m' +
    '<extra></extra>';
}

function line(colour, width, more) {
  return {type: 'scatter', mode: 'lines', hoverinfo: 'skip', line: {color: colour, width, ...more}};
}

function points(x, y, colour, symbol, size, more) {
  return {type: 'scatter', mode: 'markers', x, y, hoverinfo: 'skip',
    marker: {color: colour, symbol, size, line: {width: 1.6, color: colour}, ...more}};
}

// Those that change with the step have a function that gives what changes.
const LAYERS = [
  {group: 'truth', trace: () => ({...line('$truth', 5), opacity: 0.35, x: '@true_x', y: '@true_y'})},
  {group: 'estimate', trace: () => ({...line('$estimate', 1), opacity: 0.4, x: '@x', y: '@y'})},
  ...SOURCES.map(({colour, dash}, n) => ({
    group: `ray${n}`, trace: () => line(colour, 1.8, {dash}), at: (now) => now.rays[n]})),
  {group: 'truth', trace: () => points(data.truth.va[0], data.truth.va[1], '$truth', 'square-open', 15)},
  {group: 'truth', trace: () => points(data.truth.sp[0], data.truth.sp[1], '$truth', 'circle-open', 15)},
  {group: 'ellipses', trace: () => line('$va', 1.2), at: (now) => now.va.outline},
  {group: 'ellipses', trace: () => line('$sp', 1.2), at: (now) => now.sp.outline},
  {group: 'va', trace: () => landmarks('VA', '$va'), at: (now) => marked(now.va)},
  {group: 'sp', trace: () => landmarks('SP', '$sp'), at: (now) => marked(now.sp)},
  {group: 'bs', trace: () => ({...points([data.bs[0]], [data.bs[1]], '$text', 'triangle-up', 14),
    hoverinfo: 'text', text: ['base station']})},
  {group: 'estimate', trace: () => line('$estimate', 2.6), at: (now) => now.driven},
  {group: 'ellipses', trace: () => line('$estimate', 1.4), at: (now) => now.ellipse},
  {group: 'truth', trace: () => points([], [], '$truth', 'circle-open', 15),
    at: ({k}) => ({x: [columns.true_x[k]], y: [columns.true_y[k]]})},
  {group: 'estimate', trace: () => points([], [], '$estimate', 'arrow', 17, {
    line: {width: 1.2, color: '$card'}}),
    at: ({k}) => ({x: [columns.x[k]], y: [columns.y[k]],
      'marker.angle': 90 - columns.heading[k] * 180 / Math.PI})},
];

function landmarks(name, colour) {
  return {...points([], [], colour, 'circle', 9), hoverinfo: undefined, hovertemplate: hover(name)};
}

function marked({x, y, opacity, symbol, info}) {
  return {x, y, customdata: info, 'marker.opacity': opacity, 'marker.symbol': symbol};
}

const MOVING = LAYERS.flatMap(({at}, number) => (at ? [number] : []));

function stateAt(k) {
  return {
    k, rays: raysAt(k), va: landmarksAt(k, VA), sp: landmarksAt(k, SP), ellipse: vehicleEllipse(k),
    driven: {x: columns.x.subarray(0, k + 1), y: columns.y.subarray(0, k + 1)}};
}

function changesAt(k) {
  const now = stateAt(k), changes = {};
  MOVING.forEach((number, place) => {
    for (const [name, value] of Object.entries(LAYERS[number].at(now))) {
      changes[name] = changes[name] || new Array(MOVING.length).fill(undefined);
      changes[name][place] = value;
    }
  });
  return changes;
}

// --- showing a step ------------------------------------------------------------------------------

function mapLayout() {
  const [x0, x1, y0, y1] = data.extent;
  return {
    ...commonLayout(), showlegend: false, hovermode: 'closest', dragmode: 'pan',
    margin: {l: 52, r: 10, t: 10, b: 40}, uirevision: 'kept',
    xaxis: axis({title: {text: 'x [m]'}, range: [x0, x1]}),
    yaxis: axis({title: {text: 'y [m]'}, range: [y0, y1], scaleanchor: 'x', scaleratio: 1}),
  };
}

const hiddenGroups = new Set();

function drawMap() {
  const traces = LAYERS.map(({trace, group}) => (
    {...resolved(trace()), visible: !hiddenGroups.has(group)}));
  Plotly.react(map, traces, mapLayout(), {displayModeBar: false, responsive: true, scrollZoom: true});
  Plotly.restyle(map, changesAt(Math.max(shown, 0)), MOVING);
}

function show(k) {
  k = Math.min(Math.max(k, 0), steps - 1);
  if (k === shown) return;
  shown = k;
  Plotly.restyle(map, changesAt(k), MOVING);
  slider.value = k;
  slider.setAttribute('aria-valuetext', `step ${k + 1}, ${columns.time[k].toFixed(2)} s`);
  document.getElementById('now').textContent =
    `${columns.time[k].toFixed(2)} s · step ${k + 1} of ${steps}`;
  moveCursors(columns.time[k]);
  writeNumbers(k);
  writePaths(k);
}

// However fast the slider moves, a frame is drawn once.
let wanted = null;
function ask(k) {
  if (wanted === null) {
    requestAnimationFrame(() => {
      const next = wanted;
      wanted = null;
      show(next);
    });
  }
  wanted = k;
}

// --- the step in numbers -------------------------------------------------------------------------

function number(value, digits) { return Number.isFinite(value) ? value.toFixed(digits) : '–'; }

function writeNumbers(k) {
  const c = columns;
  document.getElementById('pose').textContent = `x ${number(c.x[k], 2)} m, y ${number(c.y[k], 2)} m, ` +
    `heading ${number(c.heading[k] * 180 / Math.PI, 1)}°, clock bias ${number(c.clock[k], 2)} m`;
  for (const cell of document.querySelectorAll('#numbers td[data-column]')) {
    cell.textContent = number(columns[cell.dataset.column][k], Number(cell.dataset.digits));
  }
}

const MOST_ROWS = 12;

function writePaths(k) {
  const c = columns, rows = [], first = c.path_start[k], last = c.path_start[k + 1];
  for (let i = first; i < Math.min(last, first + MOST_ROWS); i++) {
    const row = document.createElement('tr'), source = SOURCES[c.path_source[i]];
    const id = c.path_id[i] > 0 ? ` ${c.path_id[i]}` : '';
    const cells = [`${source.name}${id}`, number(c.path_weight[i], 3), number(c.path_length[i], 2),
      number(c.path_azimuth[i], 1), number(c.path_doppler[i], 2)];
    for (const text of cells) row.insertCell().textContent = text;
    const swatch = document.createElement('i');
    swatch.style.setProperty('--colour', theme.colour(source.colour.slice(1)));
    swatch.className = 'swatch';
    row.cells[0].prepend(swatch);
    rows.push(row);
  }
  document.getElementById('paths').replaceChildren(...rows);
  const more = last - first - MOST_ROWS;
  document.getElementById('more-paths').textContent = more > 0 ? `and ${more} more` : '';
}

// --- controls ------------------------------------------------------------------------------------

const player = {time: 0, last: null, playing: false};
const playButton = document.getElementById('play');
const speed = document.getElementById('speed');

// The last step whose time has come.
function stepAt(time) {
  let low = 0, high = steps - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (columns.time[middle] <= time) low = middle; else high = middle - 1;
  }
  return low;
}

function frame(now) {
  if (!player.playing) return;
  if (player.last !== null) player.time += (now - player.last) / 1000 * Number(speed.value);
  player.last = now;
  show(stepAt(player.time));
  if (player.time >= columns.time[steps - 1]) setPlaying(false);
  else requestAnimationFrame(frame);
}

function setPlaying(on) {
  player.playing = on;
  playButton.textContent = on ? 'Pause' : 'Play';
  playButton.setAttribute('aria-pressed', String(on));
  if (!on) return;
  player.time = shown >= steps - 1 ? columns.time[0] : columns.time[shown];
  player.last = null;
  requestAnimationFrame(frame);
}

function jump(k) {
  setPlaying(false);
  ask(k);
}

const KEYS = {
  ' ': () => setPlaying(!player.playing), ArrowRight: () => jump(shown + 1),
  ArrowLeft: () => jump(shown - 1), PageDown: () => jump(shown + 10),
  PageUp: () => jump(shown - 10), Home: () => jump(0), End: () => jump(steps - 1)};

document.addEventListener('keydown', (event) => {
  const at = event.target;
  if (at.closest('select, input:not([type=range]), button, a, summary') ||
      event.ctrlKey || event.altKey || event.metaKey || !KEYS[event.key]) return;
  event.preventDefault();
  KEYS[event.key]();
});

playButton.addEventListener('click', () => setPlaying(!player.playing));
slider.addEventListener('input', () => jump(Number(slider.value)));
document.getElementById('fit').addEventListener('click', () => {
  const [x0, x1, y0, y1] = data.extent;
  Plotly.relayout(map, {'xaxis.range': [x0, x1], 'yaxis.range': [y0, y1]});
});
document.getElementById('magnified').addEventListener('change', (event) => {
  magnified = Number(event.target.value);
  Plotly.restyle(map, changesAt(shown), MOVING);
});
for (const box of document.querySelectorAll('#layers input')) {
  box.addEventListener('change', () => {
    hiddenGroups[box.checked ? 'delete' : 'add'](box.value);
    const mine = LAYERS.flatMap(({group}, n) => (group === box.value ? [n] : []));
    Plotly.restyle(map, {visible: box.checked}, mine);
  });
}

function colourSwatches() {
  for (const swatch of document.querySelectorAll('[data-colour]')) {
    swatch.style.setProperty('--colour', theme.colour(swatch.dataset.colour));
  }
}

redraws.push(drawMap, colourSwatches, () => writePaths(shown));
colourSwatches();
drawMap();
startCharts((time) => jump(stepAt(time)));
show(0);
