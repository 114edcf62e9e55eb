"""What SQL cannot say: intervals, aggregates, comparisons, tolerance, the cost of selection, sensitivity. Functions of arrays."""
