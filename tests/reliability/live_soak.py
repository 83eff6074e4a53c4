"""Test a live page for some minutes: random input, memory, pictures, delay.

    python tests/reliability/live_soak.py [--minutes 10] [--size 100] [--rule barycentre]

Starts ``pbdkit live`` and headless Chromium, performs actions of users, and prints once a minute
the memory of the server and of the page, pictures a second and those left out; at the end the delay
from the mouse to the picture. Exits 1 where memory grows by more than a tenth after the first
minute, or the page writes to its console.
"""

import argparse
import os
import random
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from playwright.sync_api import sync_playwright

CHROMIUM = "/usr/bin/chromium"
FLAGS = ["--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader"]
RULES = {
    "barycentre": {"rule": "{type: barycentre}", "frame": "{type: mean}"},
    "elastic": {"rule": "{type: elastic, poisson_ratio: 0.3}", "frame": "{type: natural}"},
}
EXPERIMENT = """
name: soak
lattice: {{type: square, a: 1.0}}
body: {{type: grid, columns: {size}, rows: {size}}}
neighbours: {{type: chebyshev, shells: 1}}
rule: {rule}
frame: {frame}
leaders:
  - {{select: {{edge: left}}, motion: {{type: hold}}}}
  - {{select: {{edge: right}}, motion: {{type: velocity, velocity: [0.02, 0.0], steps: 100}}}}
steps: 1000
"""
DELAYS = """count => new Promise(done => {
  const { view, canvas } = pbdkitLive, delays = [];
  const row = view.kinds.lastIndexOf(0);
  const place = () => view.toClient(view.positions[2 * row], view.positions[2 * row + 1]);
  const mouse = (type, at) => canvas.dispatchEvent(new PointerEvent(type, {
    clientX: at[0], clientY: at[1], pointerId: 1, button: 0, bubbles: true }));
  canvas.setPointerCapture = () => {};
  const home = place();
  mouse('pointermove', home); mouse('pointerdown', home);
  let begin = 0, aim = home;
  const next = () => {
    if (delays.length >= count) { mouse('pointerup', aim); return done(delays); }
    aim = [home[0] - 10 - 8 * (delays.length % 5), home[1] + 6 * (delays.length % 7)];
    begin = performance.now();
    mouse('pointermove', aim);
    requestAnimationFrame(look);
  };
  const look = () => {
    const [x, y] = place();
    if (Math.hypot(x - aim[0], y - aim[1]) > 0.5 && performance.now() - begin < 3000) {
      return requestAnimationFrame(look);
    }
    delays.push(performance.now() - begin);
    setTimeout(next, 20 + 60 * Math.random());
  };
  next();
})"""


def resident(pid):
    """MiB of a process."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(re.search(r"VmRSS:\s*(\d+)", status)[1]) / 1024


def something(page, dice):
    """Whatever a user may do."""
    x, y = dice.uniform(20, 960), dice.uniform(20, 780)
    kind = dice.choice(["drag"] * 6 + ["cut", "turn", "key", "wheel", "rewind", "speed", "colour"])
    if kind in ("drag", "cut"):
        page.keyboard.press("c") if kind == "cut" else None
        page.mouse.move(x, y)
        page.mouse.down()
        for _ in range(8):
            x, y = x + dice.gauss(0, 12), y + dice.gauss(0, 12)
            page.mouse.move(x, y)
            time.sleep(0.02)
        page.mouse.up()
        page.keyboard.press("c") if kind == "cut" else None
    elif kind == "key":
        page.keyboard.press(dice.choice(["ArrowLeft", "ArrowRight", "f"]))
    elif kind == "wheel":
        page.mouse.wheel(0, dice.choice([-120, 120]))
        page.keyboard.press("f")
    elif kind == "colour":
        page.get_by_label("Colour").select_option(dice.choice(["kind", "u", "pe1", "strain_xx"]))
    else:
        names = {"rewind": "step to go back to", "speed": "speed"}
        name = names.get(kind) or "solver.relaxation"
        share = {"rewind": (0.5, 1.0), "speed": (0.0, 0.3)}.get(kind, (0.3, 0.5))
        page.get_by_role("slider", name=name, exact=True).evaluate(
            "(slider, share) => { slider.value = share * slider.max;"
            " slider.dispatchEvent(new Event('input')); }",
            dice.uniform(*share),
        )
    page.evaluate("pbdkitLive.running || pbdkitLive.send({ do: 'play', on: true })")


def cut(page):
    """Across the middle of what is shown."""
    page.keyboard.press("c")
    page.mouse.move(480, 380)
    page.mouse.down()
    page.mouse.move(520, 420, steps=3)
    page.mouse.up()
    page.keyboard.press("c")


def figures(page, server):
    """Return the figures of a moment."""
    told = page.evaluate(
        "({ second: pbdkitLive.perSecond, lost: pbdkitLive.lostPictures, drawn: pbdkitLive.drawn,"
        " step: pbdkitLive.step })"
    )
    client = page.context.new_cdp_session(page)
    client.send("HeapProfiler.collectGarbage")
    heap = client.send("Runtime.getHeapUsage")["usedSize"] / 2**20
    client.detach()
    return {"server": resident(server), "page": heap} | told


def main():
    """Prints figures; exits 1 where something grows or goes wrong."""
    options = argparse.ArgumentParser()
    options.add_argument("--minutes", type=float, default=10)
    options.add_argument("--size", type=int, default=100)
    options.add_argument("--rule", choices=RULES, default="barycentre")
    options.add_argument("--seed", type=int, default=0)
    asked = options.parse_args()
    dice, wrong, seen = random.Random(asked.seed), [], []
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        file = Path(folder) / "soak.yaml"
        file.write_text(EXPERIMENT.format(size=asked.size, **RULES[asked.rule]))
        command = [sys.executable, "-m", "pbdkit", "live", str(file), "--no-browser"]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder)
        address = re.search(r"http\S+", server.stdout.readline())[0]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.on("console", lambda message: wrong.append(message.text))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.goto(address)
        time.sleep(3)
        page.keyboard.press(" ")
        cut(page)  # so that states hold all that they may
        time.sleep(5)
        rates = []
        for _ in range(5):
            time.sleep(1)
            rates.append(page.evaluate("pbdkitLive.perSecond"))
        print(f"{asked.size} x {asked.size}, {asked.rule}, load {os.getloadavg()[0]:.1f}")
        print(f"pictures a second, nobody doing anything: {statistics.median(rates):.0f}")
        delays = sorted(page.evaluate(DELAYS, 60))
        print(f"mouse to picture: median {delays[30]:.0f} ms, 9 of 10 within {delays[54]:.0f} ms")
        print(page.locator("aside .faint").nth(1).inner_text(), flush=True)
        begin = told = time.monotonic()
        while time.monotonic() - begin < 60 * asked.minutes:
            something(page, dice)
            if time.monotonic() - told >= 60:
                told = time.monotonic()
                now = figures(page, server.pid)
                seen.append(now)
                words = ", ".join(f"{name} {value:.0f}" for name, value in now.items())
                minute = (told - begin) / 60
                print(f"minute {minute:.0f}: {words}, load {os.getloadavg()[0]:.1f}", flush=True)
        browser.close()
        server.terminate()
        server.wait(30)
    grown = [
        name for name in ("server", "page") if seen and seen[-1][name] > 1.1 * seen[0][name] + 10
    ]
    print("grown:", grown or "nothing", "console:", wrong or "nothing")
    sys.exit(1 if grown or wrong else 0)


if __name__ == "__main__":
    main()
