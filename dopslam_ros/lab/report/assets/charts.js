// The charts of a page: columns by name, colours by theme, a cursor at the time that is shown.
'use strict';

const data = JSON.parse(document.getElementById('data').textContent);

const KINDS = {f4: Float32Array, f8: Float64Array, i4: Int32Array};

function unpack({kind, data}) {
  const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
  return new KINDS[kind](bytes.buffer);
}

const columns = Object.fromEntries(
  Object.entries(data.columns).map(([name, packed]) => [name, unpack(packed)]));

// --- theme ---------------------------------------------------------------------------------------

const theme = {
  get name() { return document.documentElement.dataset.theme; },
  colour(name) {
    if (name.endsWith('~')) return faint(this.colour(name.slice(0, -1)));
    return data.palette[name][this.name === 'dark' ? 1 : 0];
  },
};

function faint(hex) {
  const parts = [1, 3, 5].map((start) => parseInt(hex.slice(start, start + 2), 16));
  return `rgba(${parts.join(',')},0.2)`;
}

// "@name" becomes a column, "$name" a colour.
function resolved(value) {
  if (typeof value === 'string') {
    if (value[0] === '@') return columns[value.slice(1)];
    if (value[0] === '$') return theme.colour(value.slice(1));
    return value;
  }
  if (Array.isArray(value)) return value.map(resolved);
  if (value && typeof value === 'object' && !ArrayBuffer.isView(value)) {
    return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, resolved(item)]));
  }
  return value;
}

function axis(more) {
  return {
    gridcolor: theme.colour('grid'), linecolor: theme.colour('axis'), zeroline: false,
    ticks: 'outside', tickcolor: theme.colour('axis'), ticklen: 4, showline: true,
    title: {standoff: 8}, ...more};
}

function commonLayout() {
  return {
    paper_bgcolor: 'rgba(0,0,0,0)', plot_bgcolor: 'rgba(0,0,0,0)',
    font: {family: 'system-ui, -apple-system, "Segoe UI", sans-serif', size: 12,
      color: theme.colour('text')},
    hoverlabel: {bgcolor: theme.colour('card'), bordercolor: theme.colour('axis'),
      font: {color: theme.colour('text')}},
  };
}

// --- charts --------------------------------------------------------------------------------------

const charts = [];

function chartLayout(spec) {
  const layout = resolved(spec.layout);
  return {
    ...commonLayout(), hovermode: 'x unified', showlegend: false, bargap: 0,
    margin: {l: 56, r: 14, t: 8, b: 40}, dragmode: 'zoom', uirevision: 'kept',
    ...layout,
    xaxis: axis({title: {text: data.xTitle, standoff: 6}, range: [...data.xRange],
      ...(layout.xaxis || {})}),
    yaxis: axis({automargin: false, fixedrange: true, ...(layout.yaxis || {})}),
  };
}

function drawChart({plot, spec}) {
  return Plotly.react(plot, resolved(spec.traces), chartLayout(spec),
    {displayModeBar: false, responsive: true});
}

// One after the other, so that the page answers in between.
async function startCharts(onPick) {
  for (const spec of data.charts) {
    const plot = document.getElementById(spec.key);
    const cursor = document.createElement('div');
    cursor.className = 'cursor';
    plot.parentElement.append(cursor);
    charts.push({spec, plot, cursor});
  }
  for (const chart of charts) {
    const {plot} = chart;
    await new Promise((resolve) => setTimeout(resolve));
    await drawChart(chart);
    plot.on('plotly_click', (event) => onPick && onPick(event.points[0].x));
    if (chart.spec.overTime) plot.on('plotly_relayout', (change) => shareZoom(plot, change));
    plot.on('plotly_afterplot', () => moveCursors());
  }
  moveCursors();
  document.body.dataset.ready = 'yes';
}

// All charts show the same piece of time.
const timed = () => charts.filter(({spec}) => spec.overTime);

let sharing = false;
function shareZoom(source, change) {
  if (sharing || !Object.keys(change).some((key) => key.startsWith('xaxis.'))) return;
  sharing = true;
  // A double click asks for all of it.
  const {range, autorange} = source.layout.xaxis;
  const same = {'xaxis.range': [...(autorange ? data.xRange : range)]};
  const others = timed().filter(({plot}) => autorange || plot !== source);
  Promise.all(others.map(({plot}) => Plotly.relayout(plot, same))).then(() => {
    sharing = false;
    moveCursors();
  });
}

let cursorTime = null;
function moveCursors(time) {
  if (typeof time === 'number') cursorTime = time;
  if (cursorTime === null) return;
  for (const {plot, cursor} of timed()) {
    const full = plot._fullLayout;
    if (!full || !full.xaxis) continue;
    const {_offset: left, _length: width, range} = full.xaxis;
    const share = (cursorTime - range[0]) / (range[1] - range[0]);
    cursor.hidden = !(share >= 0 && share <= 1);
    cursor.style.transform = `translateX(${left + share * width}px)`;
    cursor.style.top = `${full.yaxis._offset}px`;
    cursor.style.height = `${full.yaxis._length}px`;
  }
}

// --- light and dark ------------------------------------------------------------------------------

const prefersDark = window.matchMedia('(prefers-color-scheme: dark)');
const redraws = [() => charts.forEach(drawChart), colourSwatches];

function colourSwatches() {
  for (const swatch of document.querySelectorAll('[data-colour]')) {
    swatch.style.setProperty('--colour', theme.colour(swatch.dataset.colour));
  }
}

function setTheme(name) {
  document.documentElement.dataset.theme = name;
  document.getElementById('theme').textContent = name === 'dark' ? 'Light' : 'Dark';
  redraws.forEach((redraw) => redraw());
}

document.documentElement.dataset.theme = prefersDark.matches ? 'dark' : 'light';
document.getElementById('theme').textContent = prefersDark.matches ? 'Light' : 'Dark';
prefersDark.addEventListener('change', (event) => setTheme(event.matches ? 'dark' : 'light'));
document.getElementById('theme').addEventListener(
  'click', () => setTheme(theme.name === 'dark' ? 'light' : 'dark'));
colourSwatches();
