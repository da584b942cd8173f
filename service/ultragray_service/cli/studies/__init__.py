"""Commands that train and measure: train, eval, compare, report, bench."""
