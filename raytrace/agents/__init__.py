"""The server of agents, as language models are: `raytrace mcp`, by the Model Context Protocol (MCP).

- `tools`: the table of tools. A tool is a command, and its options are the parameters.
- `folder`: the one folder below which files are read and written.
- `worker`: a process that runs commands, one after the other; a cancelled one is interrupted, then ended.
- `server`: lists and calls the tools for a client. It loads no torch.
"""
