// What is shown and when: the step chosen, its numbers, and the controls that choose it.
'use strict';

const slider = document.getElementById('step');
const steps = columns.time.length;

let shown = -1;

// --- showing a step ------------------------------------------------------------------------------

function show(k) {
  k = Math.min(Math.max(k, 0), steps - 1);
  if (k === shown) return;
  shown = k;
  drawStep(k);
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
  const pose = [`x ${number(c.x[k], 2)} m`, `y ${number(c.y[k], 2)} m`,
    `heading ${number(c.heading[k] * 180 / Math.PI, 1)}°`, `clock bias ${number(c.clock[k], 2)} m`];
  // Each of them stays on one line.
  document.getElementById('pose').textContent =
    pose.map((part) => part.replaceAll(' ', '\u00a0')).join(', ');
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
    swatch.style.setProperty('--colour', resolved(source.colour));
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
document.getElementById('fit').addEventListener('click', fit);
document.getElementById('magnified').addEventListener('change', (event) => {
  magnified = Number(event.target.value);
  drawStep(shown);
});
for (const box of document.querySelectorAll('#layers input')) {
  box.addEventListener('change', () => showGroup(box.value, box.checked));
}

redraws.push(() => writePaths(shown));
startCharts((time) => jump(stepAt(time)));
show(0);
