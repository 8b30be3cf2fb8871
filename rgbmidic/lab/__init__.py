"""The laboratory: virtual experiments, the paper's measures, planning, inspection, the demonstration."""
