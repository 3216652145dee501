"""The experiments of the thesis, repeated: flights, tables and figures."""
