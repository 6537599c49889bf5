// The audience's link, seen by the presenter: made, copied and ended here, and how many watch.

const WATCHED = 2000; // milliseconds between two counts while there is a link

const part = (name) => find(`audience-${name}`);
const PRESENTS = "morph-presents"; // in this tab's storage while its viewer is the one that the audience sees

let audience = { open: false, watching: 0, most: 0, presenter: null };

async function askAudience(method, content) {
  const body = content && JSON.stringify(content);
  const response = await fetch("api/audience", { method, headers: body ? { "Content-Type": "application/json" } : {}, body, cache: "no-store" });
  const answer = await response.json();
  if (!response.ok) throw new Error(answer.detail);
  audience = answer;
  showAudience();
}

// Ask the server, and say in the dialog what it refuses.
async function ofAudience(method, content) {
  await askAudience(method, content).then(() => sayRefused(""), (error) => sayRefused(error.message));
}

function sayRefused(sentence) {
  part("refused").hidden = !sentence;
  part("refused").textContent = sentence;
}

function people(count) {
  return count === 1 ? "1 person is watching" : `${count || "nobody"} ${count ? "people are" : "is"} watching`;
}

function showAudience() {
  const { open, link, watching, most, presenter } = audience;
  const here = presenter === null || presenter === key;
  find("invite").toggleAttribute("data-open", open);
  find("watching").classList.toggle("visually-hidden", !open);
  find("watching").textContent = open ? String(watching) : "Audience";
  find("invite").title = open ? `${people(watching)}` : "A link for an audience, who can only look";
  part("words").textContent = open
    ? `${people(watching)[0].toUpperCase()}${people(watching).slice(1)}, of ${most} at most. They see the scene, the curves and the playback of ${here ? "this page" : "another page"}, and can change nothing.`
    : "Whoever has the link sees the scene, the curves and the playback of this page, and can change nothing. You can end it at any time.";
  part("link").hidden = part("end").hidden = !open;
  part("make").hidden = open;
  part("here").hidden = !open || here;
  part("address").value = open ? new URL(link, location.href.split("?")[0]).href : "";
  part("reach").hidden = !open || !/^(localhost|127\.|\[::1\])/.test(location.hostname);
}

async function invite() {
  sessionStorage.setItem(PRESENTS, "yes");
  await ofAudience("POST", { presenter: key });
}

async function countAudience() {
  if (audience.open || find("audience").open) await askAudience("GET").catch(() => null); // the page says what is wrong with the server
  setTimeout(countAudience, WATCHED);
}

find("invite").addEventListener("click", async () => {
  find("audience").showModal();
  await ofAudience("GET");
});
part("make").addEventListener("click", invite);
part("here").addEventListener("click", invite);
part("end").addEventListener("click", async () => {
  sessionStorage.removeItem(PRESENTS);
  await ofAudience("DELETE");
});
part("copy").addEventListener("click", async () => {
  part("address").select();
  const copied = await navigator.clipboard?.writeText(part("address").value).then(() => true, () => false);
  part("copy").textContent = copied || document.execCommand("copy") ? "Copied" : "Copy it by hand";
  setTimeout(() => (part("copy").textContent = "Copy"), 2000);
});
part("close").addEventListener("click", () => find("audience").close());
find("audience").addEventListener("close", focusViewer);
find("invite").hidden = !has3d; // without a viewer this page has nothing to show to others

// After a reload this page has another key: it goes on presenting, where it did.
askAudience("GET").then(() => audience.open && sessionStorage.getItem(PRESENTS) && invite(), () => null);
showAudience();
countAudience();
