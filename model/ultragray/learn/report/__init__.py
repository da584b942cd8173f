"""What was learned, on paper: plots, tables and the page of a trained scene."""
