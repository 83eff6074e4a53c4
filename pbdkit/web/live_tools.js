/** What the mouse does to the body: leads particles, and cuts. */

const APART_MS = 8; // between two places that a particle is led to
const SVG = "http://www.w3.org/2000/svg";

/** Listens until the signal; `live.tool` says what the mouse is: "lead" or "cut". */
export function handle(live, signal) {
  const { canvas, view } = live;
  const on = (name, act) => canvas.addEventListener(name, act, { signal });
  const line = document.createElementNS(SVG, "line");
  live.overlay.replaceChildren(line);
  let held = null; // where the mouse took hold, in the window and on the lattice
  let pointer = null; // where the mouse is; a finger is nowhere until it touches
  let sent = 0, waiting = false;

  const mark = (ax, ay, bx, by) => {
    const at = canvas.getBoundingClientRect();
    const [x1, y1, x2, y2] = [ax - at.left, ay - at.top, bx - at.left, by - at.top];
    for (const [name, value] of Object.entries({ x1, y1, x2, y2 })) line.setAttribute(name, value);
  };
  const lead = () => {
    waiting = false;
    sent = performance.now();
    if (held?.tool !== "lead") return;
    const [x, y] = view.toWorld(...held.now);
    live.send({ do: "drag", by: [x - held.world[0], y - held.world[1]] });
  };
  view.pans = (x, y) => live.tool === "lead" && meant(live, x, y) < 0;
  live.marks = () => {
    if (!held) return hover(live, pointer);
    if (held.tool === "cut") return mark(...held.begin, ...held.now);
    const [x, y] = view.positions.subarray(2 * held.row, 2 * held.row + 2);
    mark(...view.toClient(x, y), ...held.now);
  };

  on("pointerdown", (event) => {
    const begin = [event.clientX, event.clientY];
    const row = live.tool === "lead" ? meant(live, ...begin) : -1;
    if (event.button !== 0 || (live.tool === "lead" && row < 0)) return;
    canvas.setPointerCapture(event.pointerId);
    held = { begin, now: begin, world: view.toWorld(...begin), row, tool: live.tool };
    live.root.dataset.held = live.tool;
    if (live.tool === "lead") {
      live.send({ do: "grab", row });
      ring(live, row, -1);
    }
    live.marks();
  });
  on("pointermove", (event) => {
    const now = [event.clientX, event.clientY];
    if (event.pointerType !== "touch") pointer = now;
    if (!held) return hover(live, pointer);
    held.now = now;
    live.marks();
    if (held.tool !== "lead" || waiting) return;
    if (performance.now() - sent > APART_MS) return lead();
    waiting = true;
    setTimeout(lead, APART_MS);
  });
  on("pointerup", () => {
    if (!held) return;
    if (held.tool === "lead") {
      if (held.now !== held.begin) lead();
      live.send({ do: "release" });
    } else {
      cut(live, held);
    }
    forget();
  });
  on("pointercancel", () => { if (held?.tool === "lead") live.send({ do: "release" }); forget(); });
  on("pointerleave", () => {
    pointer = null;
    if (!held) hover(live, null);
  });

  function forget() {
    held = null;
    delete live.root.dataset.held;
    hover(live, pointer);
  }
}

/** The row of the particle that can be led there, or -1. */
function meant(live, x, y) {
  const row = live.view.pickParticle(x, y);
  return row >= 0 && live.view.kinds[row] < 2 ? row : -1;
}

/** Shows what a press would catch. */
function hover(live, at) {
  const { view } = live;
  const row = at && live.tool === "lead" ? meant(live, ...at) : -1;
  const bond = at && live.tool === "cut" ? view.pickBond(...at) : -1;
  ring(live, row, bond);
}

function ring({ view, root, tellValue }, row, bond) {
  if (row === view.selected.particle && bond === view.selected.bond) return;
  view.select(row);
  view.selectBond(bond);
  root.dataset.over = row < 0 ? "" : ["leader", "follower"][view.kinds[row]];
  tellValue();
  view.draw();
}

/** Along the line that was drawn, or the bond that was clicked. */
function cut(live, { begin, now }) {
  const { view, send } = live;
  if (Math.hypot(now[0] - begin[0], now[1] - begin[1]) >= 4) {
    send({ do: "cut", from: view.toWorld(...begin), to: view.toWorld(...now) });
    return;
  }
  const row = view.pickBond(...begin);
  if (row >= 0) send({ do: "cut-bond", row });
  else live.say("Draw a line across bonds, or zoom in and click one.");
}
