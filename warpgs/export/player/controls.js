// Mouse, touch, keys and the bar at the bottom of the page.
const EMBEDDED = window.parent !== window;
document.body.classList.toggle('embedded', EMBEDDED);
const update = () => { state.changed = true; };
const toggle = () => { state.playing = !state.playing; update(); };
const home = () => { element('follow').checked = track.length > 0; orbit.reset(); update(); };
const moving = (move) => (right, down) => { // ends following the training camera
  element('follow').checked = false;
  if (FILMED) orbit.within(FILMED, move, right, down);
  else move(right, down);
  update();
};
const rotate = moving((right, down) => orbit.rotate(right, down)), pan = moving((right, down) => orbit.pan(right, down));
const zoomed = moving((steps) => orbit.zoom(Math.exp(steps))), zoom = (factor) => zoomed(Math.log(factor));
const pointers = new Map();
element('play').onclick = toggle;
element('home').onclick = home;
element('link').onclick = () => {
  history.replaceState(null, '', addressHere()); // where the clipboard is not allowed, the address bar has it
  navigator.clipboard?.writeText(location.href).catch(() => {});
};
element('time').oninput = () => { state.playing = false; state.time = Number(element('time').value); update(); };
for (const id of [...NAMES, 'follow']) element(id).onchange = update;
canvas.oncontextmenu = (event) => event.preventDefault();
canvas.onpointerdown = (event) => {
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
};
canvas.onpointerup = canvas.onpointercancel = (event) => pointers.delete(event.pointerId);
canvas.onpointermove = (event) => {
  const last = pointers.get(event.pointerId);
  if (!last) return;
  const right = (event.clientX - last[0]) / canvas.clientHeight, down = (event.clientY - last[1]) / canvas.clientHeight;
  const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
  if (other) {
    const distance = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
    zoom(distance(last) / Math.max(1, distance([event.clientX, event.clientY])));
    pan(right / 2, down / 2);
  } else if (event.buttons & 2 || event.shiftKey) {
    pan(right, down);
  } else {
    rotate(3 * right, -3 * down);
  }
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
};
canvas.addEventListener('wheel', (event) => {
  if (EMBEDDED && !document.hasFocus()) return; // until a click, the page around it scrolls
  event.preventDefault();
  zoom(Math.exp(event.deltaY / 800));
}, {passive: false});
// A control that was clicked does not keep the keys of the page. Those who move between controls by Tab keep the focus.
addEventListener('click', (event) => {
  if (event.detail && event.target.tagName !== 'SELECT') requestAnimationFrame(() => document.activeElement.blur());
});
element('speed').onchange = () => element('speed').blur();
addEventListener('keydown', (event) => {
  if (event.target !== document.body && event.target !== canvas) return;
  const step = lastKey > 0 ? 1 / lastKey : 0;
  if (event.key === ' ') toggle();
  else if (event.key === 'Home') home();
  else if (event.key === 'ArrowLeft' || event.key === 'ArrowRight') {
    state.playing = false;
    state.time = Math.min(1, Math.max(0, state.time + (event.key === 'ArrowLeft' ? -step : step)));
    update();
  } else return;
  event.preventDefault();
});
canvas.addEventListener('webglcontextlost', () => fail('The graphics context was lost; reload the page.'));
