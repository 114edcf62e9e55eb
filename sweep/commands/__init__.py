"""The commands of `sweep`. Each translates and reports; what it needs it imports when it is called."""
