// The theme is set before the first paint, so that a dark page never flashes white.
const savedTheme = localStorage.getItem("morph-theme");
const systemTheme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
document.documentElement.dataset.theme = savedTheme === "dark" || savedTheme === "light" ? savedTheme : systemTheme;
