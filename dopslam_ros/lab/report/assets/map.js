// The map: what stays is drawn as traces, what changes with the step as shapes. A change of shapes
// draws nothing else anew, so that it takes as long in a run of an hour as in one of a minute.
'use strict';

const map = document.getElementById('map');
const SOURCES = data.sources; // names and colours of what a path may be taken for
const VA = 1, SP = 2, CLUTTER = SOURCES.length - 1;

let magnified = data.magnified;
const hiddenGroups = new Set();

// --- pieces of shapes ----------------------------------------------------------------------------

function polygon(sides, turn) {
  return Array.from({length: sides}, (_, i) => {
    const angle = turn + 2 * Math.PI * i / sides;
    return [Math.cos(angle), Math.sin(angle)];
  });
}

const ARC = polygon(40, 0), BALL = polygon(16, 0);
const SQUARE = [[1, 1], [-1, 1], [-1, -1], [1, -1]];
const ARROW = [[1.5, 0], [-1, 0.95], [-0.45, 0], [-1, -0.95]];

const at = (x, y) => `${x.toFixed(3)},${y.toFixed(3)}`;

function outline(corners) { return `M${corners.map(([x, y]) => at(x, y)).join('L')}Z`; }

function placed(form, x, y, size, turn = 0) {
  const c = size * Math.cos(turn), s = size * Math.sin(turn);
  return outline(form.map(([u, v]) => [x + c * u - s * v, y + s * u + c * v]));
}

// The region that holds the point with the probability that the page speaks of, magnified: the
// Cholesky factor of the covariance laid over a circle.
function ellipse(x, y, xx, xy, yy) {
  const a = Math.sqrt(Math.max(xx, 0)), b = a > 0 ? xy / a : 0;
  const c = Math.sqrt(Math.max(yy - b * b, 0)), scale = data.deviations * magnified;
  return outline(ARC.map(([u, v]) => [x + scale * a * u, y + scale * (b * u + c * v)]));
}

function shape(path, colour, width, more = {}) {
  return {type: 'path', path, line: {color: theme.colour(colour), width}, ...more};
}

// --- the shapes of a step ------------------------------------------------------------------------

// Landmarks of one look are one shape: there may be many of them, but hardly many looks.
function landmarkShapes(k, type, colour, size) {
  const c = columns, looks = new Map(), ellipses = [];
  for (let i = c.landmark_start[k]; i < c.landmark_start[k + 1]; i++) {
    if (c.landmark_type[i] !== type) continue;
    const x = c.landmark_x[i], y = c.landmark_y[i], reported = c.landmark_reported[i] > 0;
    const opacity = Math.round(10 * (0.15 + 0.85 * c.landmark_existence[i])) / 10;
    const look = `${opacity} ${reported}`;
    if (!looks.has(look)) looks.set(look, {opacity, reported, parts: []});
    looks.get(look).parts.push(placed(type === VA ? SQUARE : BALL, x, y, size));
    if (reported) ellipses.push(ellipse(x, y, c.landmark_pxx[i], c.landmark_pxy[i], c.landmark_pyy[i]));
  }
  const fill = theme.colour(colour);
  return {
    marks: [...looks.values()].map(({opacity, reported, parts}) => (
      shape(parts.join(''), colour, 1.5, {opacity, fillcolor: reported ? fill : 'rgba(0,0,0,0)'}))),
    ellipses: ellipses.length ? [shape(ellipses.join(''), colour, 1.2)] : []};
}

function rayShapes(k) {
  const c = columns, rays = SOURCES.map(() => []), bs = at(data.bs[0], data.bs[1]);
  for (let i = c.path_start[k]; i < c.path_start[k + 1]; i++) {
    const source = c.path_source[i];
    if (!Number.isFinite(c.path_x[i])) continue;
    const end = source === CLUTTER ? '' : `L${bs}`;
    rays[source].push(`M${at(c.x[k], c.y[k])}L${at(c.path_x[i], c.path_y[i])}${end}`);
  }
  return rays.map((parts, source) => (parts.length && !hiddenGroups.has(`ray${source}`)
    ? [shape(parts.join(''), SOURCES[source].colour.slice(1), 1.8,
      {line: {color: resolved(SOURCES[source].colour), width: 1.8, dash: SOURCES[source].dash}})]
    : [])).flat();
}

function driven(k) {
  const parts = [];
  for (let i = 0; i <= k; i++) parts.push(at(columns.x[i], columns.y[i]));
  return `M${parts.join('L')}`;
}

function shapesAt(k) {
  const c = columns, pixel = metresPerPixel();
  const vas = landmarkShapes(k, VA, 'va', 5 * pixel), sps = landmarkShapes(k, SP, 'sp', 5.5 * pixel);
  const truth = Number.isFinite(c.true_x[k])
    ? [shape(placed(BALL, c.true_x[k], c.true_y[k], 8 * pixel), 'truth', 1.6)] : [];
  const layers = [
    ['', rayShapes(k)],
    ['ellipses', [...vas.ellipses, ...sps.ellipses]],
    ['va', vas.marks], ['sp', sps.marks],
    ['estimate', [shape(driven(k), 'estimate', 2.6)]],
    ['ellipses', [shape(ellipse(c.x[k], c.y[k], c.pxx[k], c.pxy[k], c.pyy[k]), 'estimate', 1.4,
      {name: 'vehicle'})]],
    ['truth', truth],
    ['estimate', [shape(placed(ARROW, c.x[k], c.y[k], 8 * pixel, c.heading[k]), 'card', 1,
      {fillcolor: theme.colour('estimate')})]]];
  return layers.flatMap(([group, shapes]) => (hiddenGroups.has(group) ? [] : shapes));
}

function metresPerPixel() {
  const axis = map._fullLayout.xaxis;
  return Math.abs(axis.range[1] - axis.range[0]) / axis._length;
}

// --- traces --------------------------------------------------------------------------------------

function track(x, y, colour, width, opacity) {
  return {type: 'scatter', mode: 'lines', x: `@${x}`, y: `@${y}`, hoverinfo: 'skip', opacity,
    line: {color: colour, width}};
}

function points([x, y], colour, symbol, size, text) {
  return {type: 'scatter', mode: 'markers', x, y, text, hoverinfo: 'text',
    marker: {color: colour, symbol, size, line: {width: 1.6, color: colour}}};
}

// Landmarks are drawn as shapes, which do not answer to the mouse; these points do, unseen.
function answers(name) {
  return {...points([[], []], '$text', 'circle', 14), opacity: 0, hoverinfo: undefined, hovertemplate:
    `${name} %{customdata[0]}<br>existence %{customdata[1]:.3f}<br>sigma %{customdata[2]:.2f} m` +
    '<br>x %{x:.2f}, y %{y:.2f}, z %{customdata[3]:.2f} m<extra></extra>'};
}

const TRACES = [
  ['truth', track('true_x', 'true_y', '$truth', 5, 0.35)],
  ['estimate', track('x', 'y', '$estimate', 1, 0.4)],
  ['truth', points(data.truth.va, '$truth', 'square-open', 15, 'true wall (VA)')],
  ['truth', points(data.truth.sp, '$truth', 'circle-open', 15, 'true object (SP)')],
  ['bs', points([[data.bs[0]], [data.bs[1]]], '$text', 'triangle-up', 14, 'base station')],
  ['va', answers('wall (VA)')],
  ['sp', answers('object (SP)')],
];
const ANSWERS = [TRACES.length - 2, TRACES.length - 1];

function answersAt(k) {
  const c = columns, found = {x: [[], []], y: [[], []], customdata: [[], []]};
  for (let i = c.landmark_start[k]; i < c.landmark_start[k + 1]; i++) {
    const kind = c.landmark_type[i] === VA ? 0 : 1;
    found.x[kind].push(c.landmark_x[i]);
    found.y[kind].push(c.landmark_y[i]);
    found.customdata[kind].push(
      [c.landmark_id[i], c.landmark_existence[i], c.landmark_sigma[i], c.landmark_z[i]]);
  }
  return found;
}

// --- drawing -------------------------------------------------------------------------------------

function mapLayout() {
  const [x0, x1, y0, y1] = data.extent;
  return {
    ...commonLayout(), showlegend: false, hovermode: 'closest', dragmode: 'pan',
    margin: {l: 52, r: 10, t: 10, b: 40}, uirevision: 'kept',
    xaxis: axis({title: {text: 'x [m]'}, range: [x0, x1]}),
    yaxis: axis({title: {text: 'y [m]'}, range: [y0, y1], scaleanchor: 'x', scaleratio: 1}),
  };
}

let mapStep = 0, mapScale = 0, answering = null;

function drawMap() {
  const traces = TRACES.map(([group, trace]) => (
    {...resolved(trace), visible: !hiddenGroups.has(group)}));
  Plotly.react(map, traces, mapLayout(), {displayModeBar: false, responsive: true, scrollZoom: true});
  drawStep(mapStep);
}

function drawStep(k) {
  mapStep = k;
  mapScale = metresPerPixel();
  Plotly.relayout(map, {shapes: shapesAt(k)});
  clearTimeout(answering);
  answering = setTimeout(() => Plotly.restyle(map, answersAt(mapStep), ANSWERS), 250);
}

function showGroup(group, visible) {
  hiddenGroups[visible ? 'delete' : 'add'](group);
  const mine = TRACES.flatMap(([name], number) => (name === group ? [number] : []));
  if (mine.length) Plotly.restyle(map, {visible}, mine);
  drawStep(mapStep);
}

function fit() {
  const [x0, x1, y0, y1] = data.extent;
  Plotly.relayout(map, {'xaxis.range': [x0, x1], 'yaxis.range': [y0, y1]});
}

// Marks keep their size on the screen.
function keepSizes() {
  if (mapScale && Math.abs(metresPerPixel() / mapScale - 1) > 1e-6) drawStep(mapStep);
}

redraws.push(drawMap);
drawMap();
map.on('plotly_relayout', keepSizes);
map.on('plotly_afterplot', keepSizes);
