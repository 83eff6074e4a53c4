"""Steps of a scene: the operations that compute the next state, and the engines that carry them
out.

A step is a list of operations (`program`), one for each feature of the scene: leaders, bond
breaking, followers, obstacles, frame. `numpy_engine` applies them one after the other and is the
reference; `numba_engine` and `cuda_engine` compile kernels from the lines that the operations emit.
`engine_choice` selects the engine. `rule_evaluation` evaluates the functions of rules and fracture
models, also for all other packages.
"""
