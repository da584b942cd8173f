"""Who calls, and what they may do: one answer for every front door."""
