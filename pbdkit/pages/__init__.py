"""Pages of HTML that show a dataset: what Python gathers for them, and what a browser draws."""
