// Shares and times in words: those of all pages round as the viewer's panels and the reports do, which Python writes.

const whole = new Intl.NumberFormat("en", { maximumFractionDigits: 0, useGrouping: false, roundingMode: "halfEven" }); // 12.5 is 12
const percent = (share) => `${whole.format(100 * share)} %`;

function duration(seconds) {
  if (seconds < 90) return `${Math.max(1, Math.round(seconds))} s`;
  const minutes = Math.round(seconds / 60);
  if (seconds < 5400) return `${minutes} min`;
  if (seconds < 172800) return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
  return `${Math.round(seconds / 86400)} days`;
}
