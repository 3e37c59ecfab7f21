"""What commands call: a design from beginning to end, a render, comparisons of designs."""
