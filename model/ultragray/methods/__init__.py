"""The field's methods behind one protocol: this project's scene, classical baselines, and those of other papers."""
