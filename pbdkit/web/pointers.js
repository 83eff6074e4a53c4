/** Wheel, mouse and fingers on a canvas: zoom and pan. */

/** Moves the view until the signal says that it is gone; pans only where `view.pans` agrees. */
export function listenToPointers(view, signal) {
  const { canvas } = view, fingers = new Map();
  const on = (name, act) => canvas.addEventListener(name, act, { signal });
  let pressed = [0, 0];
  canvas.style.touchAction = "none";
  on("wheel", (event) => {
    event.preventDefault();
    const pixels = (event.deltaMode ? 24 : 1) * event.deltaY;
    view.zoom(Math.exp(-0.0015 * pixels), event.clientX, event.clientY);
  });
  on("pointerdown", (event) => {
    view.dragged = false;
    if (event.button !== 0 || !view.pans(event.clientX, event.clientY)) return;
    canvas.setPointerCapture(event.pointerId);
    pressed = [event.clientX, event.clientY];
    fingers.set(event.pointerId, pressed);
  });
  on("pointermove", (event) => {
    if (!fingers.has(event.pointerId)) return;
    const now = [event.clientX, event.clientY];
    if (!view.dragged && Math.hypot(now[0] - pressed[0], now[1] - pressed[1]) < 4) return;
    view.dragged = true;
    const [x, y, apart] = middle(fingers);
    fingers.set(event.pointerId, now);
    const [nowX, nowY, nowApart] = middle(fingers);
    if (apart && nowApart) view.zoom(nowApart / apart, nowX, nowY);
    view.pan(nowX - x, nowY - y);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    on(end, (event) => fingers.delete(event.pointerId));
  }
}

/** The middle of the fingers, and how far the first is from the last. */
function middle(fingers) {
  const all = [...fingers.values()], first = all[0], last = all[all.length - 1];
  const mean = (axis) => all.reduce((sum, place) => sum + place[axis], 0) / all.length;
  return [mean(0), mean(1), Math.hypot(last[0] - first[0], last[1] - first[1])];
}
