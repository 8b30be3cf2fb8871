"""The laboratory: virtual experiments, the paper's studies, planning, inspection, the demonstration."""
