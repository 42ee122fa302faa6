"""What an end-to-end error comes from: runs under changed conditions, waterfalls, sweeps, comparisons."""
