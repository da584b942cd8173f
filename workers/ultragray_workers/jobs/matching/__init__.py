"""Which worker can do which job: what jobs demand, what workers offer. Free of torch."""
