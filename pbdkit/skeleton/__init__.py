"""New plugin projects that install, pass their tests and run as they stand."""
