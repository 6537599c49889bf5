// What every page of ours needs: what it carries unpacked, light and dark, and the licences.

const $ = (id) => document.getElementById(id);

function bytes(text) {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out;
}

/** Return the bytes that the page carries under a name; a browser that can't unpack them itself takes longer. */
async function unpacked(id) {
  const packed = bytes($(id).textContent.trim());
  if (typeof DecompressionStream !== "function") return THREE.gunzipSync(packed);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

const unpackedText = async (id) => new TextDecoder().decode(await unpacked(id));

/** Write a text that may be the one that is there, which then costs nothing. */
function put(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/** Show the picture, and that it `stays`, for as long as the browser has taken the graphics away; `before` is said again then. */
function watchGraphics(stage, stays, before) {
  stage.canvas.addEventListener("webglcontextlost", () => {
    document.body.dataset.state = "still";
    say(`The browser has taken the graphics away from this page and may give them back; if not, load it again. ${stays}`);
  });
  stage.canvas.addEventListener("webglcontextrestored", () => {
    stage.paint();
    document.body.dataset.state = "live";
    say(before);
  });
}

function say(sentence) {
  $("note").textContent = sentence;
  $("note").hidden = !sentence;
}

function connectPage() {
  const root = document.documentElement, dark = matchMedia("(prefers-color-scheme: dark)");
  const wanted = location.hash.slice(1); // a page round this one may have another theme than the reader's system
  root.dataset.theme = wanted === "dark" || (wanted !== "light" && dark.matches) ? "dark" : "light";
  $("theme").addEventListener("click", () => { root.dataset.theme = root.dataset.theme === "dark" ? "light" : "dark"; });
  $("licences").addEventListener("toggle", async () => {
    if ($("licences").open) $("licence-text").textContent ||= await unpackedText("licences-packed");
  });
}
