"""A script for viser's client, so that it opens no second connection while its first is there or on its way.

While it has the focus and no connection, the client tries again each second, whatever has become of the last try: on a
busy machine it gives up a connection that was about to open, and one that has just opened, of which it has not heard
yet. What a person has pressed meanwhile is lost then, without a word.
"""

_IN_WORKER = """
(() => {
  const Socket = self.WebSocket;
  let newest = null;
  self.WebSocket = class extends Socket {
    constructor(...words) {
      super(...words);
      newest = this;
    }
  };
  self.addEventListener("message", (event) => {
    const open = newest !== null && newest.readyState <= Socket.OPEN;
    if (event.data?.type === "retry" && open) event.stopImmediatePropagation();
  });
})();
"""
"""What runs in the client's worker, which owns the connection, before anything else does."""

SCRIPT = f"""<script>
(() => {{
  const Plain = self.Blob;
  const first = {_IN_WORKER!r};
  self.Blob = class extends Plain {{
    constructor(parts, options) {{
      super(options?.type?.startsWith("text/javascript") ? [first, ...parts] : parts, options);
    }}
  }};
}})();
</script>""".encode()
"""What stands in the head of the client's page: viser offers no hook into its worker, which is made of a Blob."""
