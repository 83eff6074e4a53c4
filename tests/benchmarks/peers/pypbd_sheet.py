"""A sheet of distance constraints along the four bonds, Gauss-Seidel by colour, in pyPBD (C++)."""

import json
import os
import sys
import time

os.environ["OMP_NUM_THREADS"] = "1"
import pypbd as pbd


def sheet(n):
    simulation = pbd.Simulation.getCurrent()
    simulation.initDefault()
    model = simulation.getModel()
    particles = model.getParticles()
    for i in range(n):
        for j in range(n):
            particles.addVertex([float(i), float(j), 0.0])
    for i in range(n):
        for j in range(n):
            k = i * n + j
            particles.setMass(k, 0.0 if i in (0, n - 1) else 1.0)
            if i + 1 < n:
                model.addDistanceConstraint(k, k + n, 1.0)
            if j + 1 < n:
                model.addDistanceConstraint(k, k + 1, 1.0)
    for j in range(n):
        k = (n - 1) * n + j
        particles.setPosition(k, [n - 1 + 0.35, float(j), 0.0])
    step = simulation.getTimeStep()
    step.setValueUInt(pbd.TimeStepController.NUM_SUB_STEPS, 1)
    return model, step


def seconds(model, step, iterations):
    step.setValueUInt(pbd.TimeStepController.MAX_ITERATIONS, iterations)
    best = float("inf")
    for _ in range(4):
        begun = time.perf_counter()
        step.step(model)
        best = min(best, time.perf_counter() - begun)
    return best


def measure(n):
    """Measure the cost of a further iteration; the other work of a step (velocities, contacts) is
    left out."""
    model, step = sheet(n)
    few, many = 2, 42 if n <= 200 else 12
    step.step(model)
    difference = seconds(model, step, many) - seconds(model, step, few)
    return difference / (many - few) / n**2 * 1e9


print(json.dumps({"distance constraints": measure(int(sys.argv[1]))}))
