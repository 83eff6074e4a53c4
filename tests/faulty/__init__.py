"""Components with one fault each; test_conformance.py contains the property that finds it."""
