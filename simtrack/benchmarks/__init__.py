"""Speed, measured: one module a benchmark, each with ``run(options) -> Benchmark``. Uses every other room."""
