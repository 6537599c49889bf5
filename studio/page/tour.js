// A tour of four steps for whoever is here for the first time; it can be dismissed, and this browser remembers that.

const SEEN = "morph-tour";
const STEPS = [
  {
    title: "Start a run",
    words: "Choose a task and a method and press Start. The body of the robot and its controller are then learnt together.",
    place: () => find("new"),
  },
  {
    title: "Watch it learn",
    words: "The scene plays the latest design, the curves on the left grow with each iteration. The timeline goes to any iteration; L follows the latest one again.",
    place: () => tab("Timeline") ?? tab("Traces"),
  },
  {
    title: "Steer it",
    words: "Pause the run, give a part other bounds, lock it, or weigh the agreement of both hardware models (α) anew: it holds from the next iteration on. What if moves the body by hand and tries the policy on it.",
    place: () => tab("Steer"),
  },
  {
    title: "Take it home",
    words: "Export puts robot and policy into a zip, once both are proved to be one robot. All runs are on the page Runs, and ? shows the keys.",
    place: () => tab("Export") ?? document.querySelector('.link[href="runs"]'),
  },
];
const [tour, ring] = ["tour", "ring"].map(find);
let step = 0;

function tab(name) {
  const tabs = viewer.contentDocument?.querySelectorAll("[role=tab]") ?? [];
  return [...tabs].find((each) => each.textContent.trim() === name && each.getClientRects().length);
}

function showStep() {
  const { title, words } = STEPS[step];
  find("tour-count").textContent = `${step + 1} of ${STEPS.length}`;
  find("tour-title").textContent = title;
  find("tour-words").textContent = words;
  find("tour-back").disabled = step === 0;
  find("tour-on").textContent = step === STEPS.length - 1 ? "Done" : "Next";
  point();
}

function point() {
  const there = STEPS[step].place();
  ring.hidden = !there;
  if (!there) return;
  const box = there.getBoundingClientRect();
  const frame = there.ownerDocument === document ? { left: 0, top: 0 } : viewer.getBoundingClientRect();
  const [left, top] = [box.left + frame.left - 4, box.top + frame.top - 4];
  Object.assign(ring.style, { left: `${left}px`, top: `${top}px`, width: `${box.width + 8}px`, height: `${box.height + 8}px` });
}

function startTour() {
  step = 0;
  tour.hidden = false;
  showStep();
  find("tour-on").focus();
}

function endTour() {
  tour.hidden = ring.hidden = true;
  localStorage.setItem(SEEN, "seen");
  focusViewer();
}

find("tour-on").addEventListener("click", () => {
  if (step === STEPS.length - 1) return endTour();
  step += 1;
  showStep();
});
find("tour-back").addEventListener("click", () => {
  step -= 1;
  showStep();
});
find("tour-end").addEventListener("click", endTour);
tour.addEventListener("keydown", (event) => event.key === "Escape" && endTour());
addEventListener("resize", () => tour.hidden || point());
find("again").addEventListener("click", () => {
  find("keys").close();
  startTour();
});
addEventListener("viewer-opened", () => localStorage.getItem(SEEN) || !tour.hidden || startTour());
