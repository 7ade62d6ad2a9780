fn main() { divff::train::trainer::experiment() }
