"""Studies, benchmarks, figures and reports: nothing here runs on a robot."""
