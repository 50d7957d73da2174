// A click on the link or on the picture before it opens the page of a policy in the picture's place.
document.addEventListener("DOMContentLoaded", () => {
  for (const link of document.querySelectorAll("a.live-page")) {
    const picture = link.closest("p").previousElementSibling;
    const open = (event) => {
      event.preventDefault();
      const page = Object.assign(document.createElement("iframe"), { src: link.href, className: "live-page" });
      page.title = picture.querySelector("img")?.alt ?? "";
      picture.replaceWith(page);
      link.textContent = "Open it alone";
      link.removeEventListener("click", open);
      page.focus();
    };
    link.addEventListener("click", open);
    picture.classList.add("live-picture");
    picture.addEventListener("click", open);
  }
});
