// The caption over the scene: what is seen, said by the scene itself in the text of an invisible node, so that words and
// body change together; and presenter's mode, in which the page shows nothing else.

const LOOK = 100; // milliseconds between two looks at the scene
const [caption, enter] = ["caption", "caption-enter"].map(find);
let told = null;

function captionOf() {
  const tree = viewer.contentWindow?.__viserSceneTree;
  return tree?.getState()["/caption"]?.message.props.text ?? "";
}

function showCaption(text) {
  const said = text ? JSON.parse(text) : { label: "", presents: false };
  caption.hidden = !said.label && !said.presents;
  present(said.presents);
  said.label = said.label.replaceAll(/(\d) (?=\S)/g, "$1\u00a0"); // a number stays with its unit
  for (const part of ["label", "title", "success", "iteration", "change"]) find(`caption-${part}`).textContent = said[part] ?? "";
  find("caption-label").hidden = !said.label;
  find("caption-detail").textContent = [said.detail, said.playing].filter(Boolean).join("\n");
  enter.hidden = !said.enter;
  enter.querySelector("span").textContent = said.enter ?? "";
}

function present(presents) {
  const roots = [document.documentElement, viewer.contentDocument?.documentElement];
  for (const root of roots) root?.toggleAttribute("data-presents", presents);
}

function lookAtCaption() {
  const text = captionOf();
  if (text !== told) showCaption(text);
  told = text;
}

// What a key does, for those who have none.
function press(key) {
  viewer.contentDocument?.documentElement.dispatchEvent(new KeyboardEvent("keydown", { key, code: key, bubbles: true }));
  focusViewer();
}

if (has3d) {
  present(view.presents);
  setInterval(lookAtCaption, LOOK);
  viewer.addEventListener("load", () => (told = null));
  find("present").hidden = false;
  find("present").addEventListener("click", () => press("f"));
  enter.addEventListener("click", () => press("Enter"));
  find("caption-leave").addEventListener("click", () => press("Escape"));
}
