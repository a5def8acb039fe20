"""Playing episodes: policy kernel, fused battle episode, generic PettingZoo loop; no torch, ray or gRPC."""
