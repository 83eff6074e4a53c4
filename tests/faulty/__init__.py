"""Components with one fault each; test_conformance.py says which property finds it."""
