"""Classical benchmarks through the public interface: one module for each group."""
