"""Methods that a comparison puts beside the scene: classical ones and those of other papers."""
