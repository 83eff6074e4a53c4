"""The model in space as plain loops: simple cubic lattice, barycentre, mean frame of one layer, and
bonds that break beyond a length. Written from the definition, apart from the program."""

from itertools import product

STEPS = [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)]


def plus(a, b):
    return tuple(x + y for x, y in zip(a, b, strict=True))


def simulate(sizes, groups, steps, threshold=None):
    """Return u of every particle, body and frame, in the order of the numbers, after each step; and
    the bonds that broke, as pairs of sites with their step. `groups` are (sites, velocity, steps):
    the leaders, their displacement per step, and the number of steps; then they hold."""
    body = set(product(*map(range, sizes)))
    window = list(product(*(range(-1, n + 1) for n in sizes)))
    u = dict.fromkeys(window, (0.0, 0.0, 0.0))
    copied = {site: nearest(site, body) for site in window if site not in body}
    broken, history = {}, []
    for step in range(1, steps + 1):
        led = {
            site: tuple(v * min(step, last) for v in velocity)
            for sites, velocity, last in groups
            for site in sites
        }
        m = u | led
        if threshold is not None:
            for a in window:
                for along in STEPS[1::2]:
                    b = plus(a, along)
                    if b in m and (a in body or b in body) and (a, b) not in broken:
                        now = [r + (q - p) for r, p, q in zip(along, m[a], m[b], strict=True)]
                        if now[0] * now[0] + now[1] * now[1] + now[2] * now[2] > threshold**2:
                            broken[a, b] = step
        new = dict(m)
        for site in body - led.keys():
            new[site] = barycentre(site, m, broken)
        for site, sources in copied.items():
            weight = 1.0 / len(sources)
            new[site] = (0.0, 0.0, 0.0)
            for source in sources:
                new[site] = plus(new[site], tuple(weight * c for c in new[source]))
        u = new
        history.append([u[site] for site in window])
    return history, broken


def nearest(site, body):
    """The body's sites nearest to a frame point, by number."""
    square = {b: sum((p - q) ** 2 for p, q in zip(site, b, strict=True)) for b in body}
    return sorted(b for b in body if square[b] == min(square.values()))


def barycentre(site, m, broken):
    """u + (Σd + Σr) / N; a lost neighbour stands where the undeformed cell has it."""
    d, r = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for along in STEPS:
        there = plus(site, along)
        bond = (min(site, there), max(site, there))
        seen = tuple(q - p for p, q in zip(m[site], m[there], strict=True))
        d = plus(d, (0.0, 0.0, 0.0) if bond in broken else seen)
        r = plus(r, along)
    return tuple(p + (a + b) / len(STEPS) for p, a, b in zip(m[site], d, r, strict=True))
