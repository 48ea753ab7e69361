"""A reduced model for other programs: VTU and XDMF series for ParaView, glTF for 3-D viewers."""
