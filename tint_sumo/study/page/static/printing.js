// On paper all is light, and all that is folded is open. Afterwards the page is as it was.

let beforePrinting = null;

addEventListener("beforeprint", () => {
  const { style } = document.documentElement;
  const folds = [...document.querySelectorAll("details:not([open])")];
  beforePrinting = { colours: style.colorScheme, folds };
  style.colorScheme = "light";
  for (const fold of folds) fold.open = true;
});

addEventListener("afterprint", () => {
  document.documentElement.style.colorScheme = beforePrinting.colours;
  for (const fold of beforePrinting.folds) fold.open = false;
});
